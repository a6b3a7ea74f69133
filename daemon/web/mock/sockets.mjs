import { meshMessage, picturePng } from "./face.mjs";

const VIEWS = ["camera", "fringe", "modulation", "phase", "mask"];
const MOST_UNACKNOWLEDGED = 4;

/** Speaks on a WebSocket of the interface. */
export function serveSocket(state, socket, path, query) {
  const most = Number(query.get("max_vertices") ?? 20_000);
  if (path === "live/events") events(state, socket);
  else if (path === "live/picture") pictures(state, socket, query);
  else if (path === "live/mesh") liveMesh(state, socket, Number(query.get("fps") ?? 10), most);
  else if (/^sessions\/[^/]+\/replay$/.test(path)) {
    replay(state.sessions.get(decodeURIComponent(path.split("/")[1])), socket, most);
  } else socket.close(1008, "no such stream");
}

/** Runs while the socket is open. */
function every(socket, millis, run) {
  const timer = setInterval(run, millis);
  socket.on("close", () => clearInterval(timer));
}

function events(state, socket) {
  const status = () => socket.send(JSON.stringify({ status: state.status() }));
  const listener = (event) => socket.send(JSON.stringify({ event }));
  state.listeners.add(listener);
  socket.on("close", () => state.listeners.delete(listener));
  status();
  every(socket, 500, status);
}

const isOn = (state) => !state.unplugged && (state.scanner === "previewing" || state.scanner === "recording");

function pictures(state, socket, query) {
  const view = query.get("view") ?? "camera";
  let sequence = 0;
  every(socket, 1000 / Number(query.get("fps") ?? 10), () => {
    if (!isOn(state) || socket.bufferedAmount > 0) return;
    const header = Buffer.alloc(24);
    header.writeUInt32LE(0x50335647, 0);
    header.set([1, VIEWS.indexOf(view)], 4);
    header.writeUInt32LE((sequence += 1), 8);
    const seconds = Date.now() / 1000 - state.began / 1000;
    header.writeDoubleLE(seconds, 16);
    socket.send(Buffer.concat([header, picturePng(view, seconds)]));
  });
}

function liveMesh(state, socket, fps, maxVertices) {
  let sequence = 0;
  every(socket, 1000 / fps, () => {
    if (!isOn(state) || socket.bufferedAmount > 0) return;
    const seconds = (Date.now() - state.began) / 1000;
    socket.send(meshMessage({ sequence: (sequence += 1), seconds, maxVertices, scalars: "depth", full: true }));
  });
}

function replay(session, socket, maxVertices) {
  if (!session) return socket.close(1008, "no such session");
  const now = { seconds: 0, play: 0, loop: false, fps: 30, scalars: "none", acknowledged: 0, sequence: 0, owed: false };
  let timer = null;
  let last = performance.now();
  const send = () => {
    if (now.sequence - now.acknowledged >= MOST_UNACKNOWLEDGED) return;
    now.owed = false;
    now.sequence += 1;
    const { sequence, seconds, scalars } = now;
    socket.send(meshMessage({ sequence, seconds, maxVertices, scalars, full: sequence === 1 }));
  };
  const step = () => {
    const elapsed = (performance.now() - last) / 1000;
    last = performance.now();
    if (now.play === 0) {
      if (now.owed) send();
      return;
    }
    now.seconds += now.play * elapsed;
    const length = session.seconds;
    if (now.seconds > length || now.seconds < 0) {
      if (now.loop) now.seconds = now.play > 0 ? 0 : length;
      else {
        now.seconds = Math.max(0, Math.min(length, now.seconds));
        now.play = 0;
      }
    }
    send();
  };
  const pace = () => {
    clearInterval(timer);
    timer = setInterval(step, 1000 / now.fps);
  };
  socket.on("message", (data) => {
    const command = JSON.parse(data.toString());
    if ("ack" in command) now.acknowledged = command.ack;
    if ("fps" in command) now.fps = command.fps;
    if ("play" in command) now.play = command.play;
    if ("loop" in command) now.loop = command.loop;
    if ("scalars" in command) now.scalars = command.scalars;
    if ("seek_seconds" in command) {
      now.seconds = Math.max(0, Math.min(session.seconds, command.seek_seconds));
      now.owed = true;
      send();
    }
    if ("fps" in command) pace();
  });
  socket.on("close", () => clearInterval(timer));
  pace();
}
