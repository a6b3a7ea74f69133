import { readFile } from "node:fs/promises";
import { createServer } from "node:http";
import { extname, join, normalize } from "node:path";
import { fileURLToPath } from "node:url";
import { WebSocketServer } from "ws";
import { answer } from "./routes.mjs";
import { serveSocket } from "./sockets.mjs";
import { MockState } from "./state.mjs";

const DIST = fileURLToPath(new URL("../dist", import.meta.url));
const TYPES = {
  ".html": "text/html",
  ".js": "text/javascript",
  ".css": "text/css",
  ".svg": "image/svg+xml",
  ".txt": "text/plain",
};
/** As the daemon sends it, so that what it forbids fails here too. */
const POLICY =
  "default-src 'self'; img-src 'self' blob: data:; worker-src 'self' blob:; style-src 'self' 'unsafe-inline'; " +
  "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'";
const API = "/api/v1/";

/** Starts a made-up daemon on loopback: the page, the interface, and `POST /mock` to break things. */
export async function startMock({ port = 0, token = null } = {}) {
  const state = new MockState();
  const allowed = (request) => !token || (request.headers.cookie ?? "").includes(`gv3_token=${token}`);
  const server = createServer((request, response) => {
    handle(state, token, allowed, request, response).catch((error) => {
      const { status = 500, title = String(error), detail = "" } = error;
      response.writeHead(status, { "Content-Type": "application/problem+json" });
      response.end(JSON.stringify({ type: "about:blank", title, status, detail }));
    });
  });
  const sockets = new WebSocketServer({ noServer: true });
  server.on("upgrade", (request, socket, head) => {
    const url = new URL(request.url, "http://mock");
    if (!allowed(request)) return socket.end("HTTP/1.1 401 Unauthorized\r\n\r\n");
    sockets.handleUpgrade(request, socket, head, (ws) =>
      serveSocket(state, ws, url.pathname.slice(API.length), url.searchParams),
    );
  });
  await new Promise((resolve) => server.listen(port, "127.0.0.1", resolve));
  const close = () => {
    for (const client of sockets.clients) client.terminate();
    server.closeAllConnections();
    return new Promise((resolve) => server.close(resolve));
  };
  return { state, port: server.address().port, url: `http://127.0.0.1:${server.address().port}/`, close };
}

async function handle(state, token, allowed, request, response) {
  const { pathname } = new URL(request.url, "http://mock");
  if (!pathname.startsWith("/api/") && pathname !== "/mock") return page(pathname, response);
  const chunks = [];
  for await (const chunk of request) chunks.push(chunk);
  const text = Buffer.concat(chunks).toString();
  const body = text ? JSON.parse(text) : {};
  if (pathname === "/mock") {
    if ("unplug" in body) state.unplug(body.unplug);
    if ("full" in body) state.fillDisk(body.full);
    return response.writeHead(204).end();
  }
  const path = pathname.slice(API.length);
  if (path === "login") {
    if (body.token !== token) throw Object.assign(new Error(), { status: 401, title: "Wrong token", detail: "" });
    response.setHeader("Set-Cookie", `gv3_token=${token}; HttpOnly; SameSite=Strict; Path=/`);
    return response.writeHead(204).end();
  }
  if (!allowed(request)) {
    throw Object.assign(new Error(), { status: 401, title: "A token is needed", detail: "Log in first." });
  }
  const [status, result] = answer(state, request.method, path, body);
  if (result?.type) {
    const name = result.name ? { "Content-Disposition": `attachment; filename="${result.name}"` } : {};
    response.writeHead(status, { "Content-Type": result.type, ...name });
    return response.end(result.bytes);
  }
  response.writeHead(status, { "Content-Type": "application/json" });
  return response.end(result === undefined ? undefined : JSON.stringify(result));
}

async function page(pathname, response) {
  const name = normalize(pathname === "/" ? "index.html" : pathname.slice(1));
  const type = TYPES[extname(name)];
  const bytes = type && !name.startsWith("..") ? await readFile(join(DIST, name)).catch(() => null) : null;
  if (!bytes) return response.writeHead(404).end();
  response.writeHead(200, { "Content-Type": type, "Content-Security-Policy": POLICY });
  return response.end(bytes);
}
