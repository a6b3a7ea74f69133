import { parseArgs } from "node:util";
import { startMock } from "./server.mjs";

const { values } = parseArgs({
  options: { port: { type: "string", default: "8433" }, token: { type: "string" }, help: { type: "boolean" } },
});
if (values.help) {
  console.log("node mock/main.mjs [--port 8433] [--token SECRET]\nA made-up daemon for work on the page.");
} else {
  const mock = await startMock({ port: Number(values.port), token: values.token ?? null });
  console.log(`mock daemon at ${mock.url}`);
}
