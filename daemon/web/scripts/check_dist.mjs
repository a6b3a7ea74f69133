// Checks that dist/ is what the sources build to, so that a machine without node has the page that is written here.
import { execFileSync } from "node:child_process";
import { mkdtempSync, readdirSync, readFileSync, rmSync } from "node:fs";
import { tmpdir } from "node:os";
import { join, relative } from "node:path";
import { fileURLToPath } from "node:url";

const root = fileURLToPath(new URL("..", import.meta.url));
const fresh = mkdtempSync(join(tmpdir(), "gv3-page-"));
try {
  execFileSync("npx", ["vite", "build", "--outDir", fresh, "--emptyOutDir", "--logLevel", "error"], {
    cwd: root,
    stdio: "inherit",
  });
  const [stored, built] = [files(join(root, "dist")), files(fresh)];
  const names = [...new Set([...stored.keys(), ...built.keys()])].sort();
  const different = names.filter((name) => !stored.get(name) || !built.get(name)?.equals(stored.get(name)));
  if (different.length) {
    console.error(`dist differs from a fresh build: ${different.join(", ")}.\nRun npm run build and commit dist.`);
    process.exitCode = 1;
  } else {
    console.log(`dist equals a fresh build (${names.length} files)`);
  }
} finally {
  rmSync(fresh, { recursive: true });
}

/** Content by path below a folder. */
function files(folder) {
  const entries = readdirSync(folder, { recursive: true, withFileTypes: true }).filter((entry) => entry.isFile());
  return new Map(
    entries.map((entry) => {
      const path = join(entry.parentPath, entry.name);
      return [relative(folder, path), readFileSync(path)];
    }),
  );
}
