import { readFileSync } from "node:fs";
import { defineConfig } from "vitest/config";
import type { Plugin } from "vite";

/** Puts the licence of the one bundled library beside the bundle. */
function licences(): Plugin {
  return {
    name: "licences",
    generateBundle() {
      const text = readFileSync(new URL("node_modules/three/LICENSE", import.meta.url), "utf8");
      const { version } = JSON.parse(
        readFileSync(new URL("node_modules/three/package.json", import.meta.url), "utf8"),
      ) as { version: string };
      this.emitFile({
        type: "asset",
        fileName: "THIRD-PARTY-LICENSES.txt",
        source: `three.js ${version}, https://threejs.org\n\n${text}`,
      });
    },
  };
}

const daemon = process.env["GV3_DAEMON"] ?? "http://127.0.0.1:8433";

export default defineConfig({
  base: "./",
  build: {
    target: "es2022",
    chunkSizeWarningLimit: 800,
    modulePreload: { polyfill: false },
  },
  plugins: [licences()],
  server: { proxy: { "/api": { target: daemon, ws: true, changeOrigin: true } } },
  test: { environment: "happy-dom", include: ["tests/**/*.test.ts"] },
});
