import { greyPng } from "./png.mjs";
import { compareReport, MEASURE, SWEEP } from "./reports.mjs";
import { problem } from "./state.mjs";
import { zipOf } from "./zip.mjs";

const thumbnail = greyPng(64, 48, (x, y) => {
  const r = Math.hypot((x - 32) / 17, (y - 24) / 22);
  return r < 1 ? 200 - 110 * r : 20;
});

const DEVICES = {
  cameras: [
    {
      node: "/dev/video0",
      name: "gv3 camera",
      driver: "uvcvideo",
      bus: "usb-1.2",
      serial: "C1",
      formats: ["GREY", "Y10 "],
    },
  ],
  projectors: [
    {
      backend: "gv3_usb",
      serial: "P1",
      bus_path: "1-1.3",
      problem: "No right to open it. Run: sudo gv3 install-udev, then plug it in again.",
    },
  ],
  serial_ports: [],
  problems: [],
};

const CHECKS = [
  { name: "camera", outcome: "pass", detail: "180 pictures a second, none lost", action: null },
  {
    name: "projector",
    outcome: "fail",
    detail: "may not be opened",
    action: "Run: sudo gv3 install-udev, then plug it in again.",
  },
  { name: "linearity", outcome: "skip", detail: "needs the projector", action: null },
  { name: "disk", outcome: "pass", detail: "412 GB free, 240 MB/s", action: null },
];

/** A body with a type other than JSON. */
const file = (type, bytes, name) => ({ type, bytes, name });

/** Answers a request of the interface: [status, body]. Throws a problem for what is refused. */
export function answer(state, method, path, body) {
  const [head, name, tail] = path.split("/").map(decodeURIComponent);
  const key = `${method} ${path}`;
  const simple = {
    "GET status": () => [200, state.status()],
    "POST scanner/start": () => {
      if (state.unplugged) throw problem(503, "The camera is not there", "Plug it in again and see Devices.");
      state.scanner = "previewing";
      return [200, {}];
    },
    "POST scanner/stop": () => ((state.scanner = "idle"), [200, {}]),
    "POST recording/start": () => [201, { session: state.startRecording(body.name, !!body.raw) }],
    "POST recording/stop": () => [200, state.stopRecording()],
    "POST recording/mark": () => (state.tell({ kind: "mark", text: body.text, tick: 42 }), [200, { tick: 42 }]),
    "POST config/reload": () => [200, {}],
    "GET devices": () => [200, state.unplugged ? { ...DEVICES, cameras: [] } : DEVICES],
    "POST doctor": () => [200, { checks: CHECKS }],
    "GET sessions": () => [200, { sessions: [...state.sessions.values()] }],
    "GET jobs": () => [200, { jobs: [...state.jobs.values()] }],
    "GET reports": () => [
      200,
      {
        reports: [
          { name: "sweep-face", kind: "sweep" },
          { name: "smile-measure", kind: "measure" },
        ],
      },
    ],
    "GET reports/sweep-face": () => [200, SWEEP],
    "GET reports/smile-measure": () => [200, MEASURE],
  }[key];
  if (simple) return simple();
  if (head === "jobs") return jobAnswer(state, method, name, tail);
  if (head !== "sessions") throw problem(404, "No such path", path);
  if (!state.sessions.has(name))
    throw problem(404, "No such session", `There is no session ${name}. Read the list again.`);
  return sessionAnswer(state, method, name, tail, body);
}

function jobAnswer(state, method, id, tail) {
  const job = state.jobs.get(id);
  if (!job) throw problem(404, "No such job", "The daemon was started again since; begin it anew.");
  if (method === "DELETE") return ((job.state = "cancelled"), [204]);
  if (tail === "result")
    return [200, file("application/zip", zipOf("frame_0000.obj", "v 0 0 0\n"), `${job.session}.zip`)];
  return [200, job];
}

function sessionAnswer(state, method, name, tail, body) {
  const known = state.sessions.get(name);
  switch (`${method} ${tail ?? ""}`) {
    case "GET ":
      return [200, state.detail(name)];
    case "GET thumbnail.png":
      return [200, file("image/png", thumbnail)];
    case "GET file":
      return [200, file("application/octet-stream", Buffer.from("GV3"), `${name}.gv3`)];
    case "GET curve": {
      const ticks = Array.from({ length: known.scans }, (_, k) => k);
      const is_key = ticks.map((t) => t % 10 === 0);
      return [200, { ticks, is_key, bytes: ticks.map((t) => (t % 10 === 0 ? 4200 : 900) + 200 * Math.sin(t)) }];
    }
    case "PATCH ":
      if (state.sessions.has(body.name))
        throw problem(409, "That name is taken", `There is a session ${body.name} already.`);
      state.sessions.delete(name);
      state.sessions.set(body.name, { ...known, name: body.name });
      return [200, {}];
    case "DELETE ":
      state.sessions.delete(name);
      return [204];
    case "POST verify":
      return [202, state.startJob("verify", name, () => ({ report: { groups: known.keyframes, faults: 0 } }))];
    case "POST recover":
      return [
        202,
        state.startJob("recover", name, () => ((known.state = "complete"), { report: { scans_kept: known.scans } })),
      ];
    case "POST export":
      return [202, state.startJob("export", name, () => ({ result_bytes: 1_234_567 }))];
    case "POST compare":
      return [202, state.startJob("compare", name, () => ({ report: compareReport(known.scans) }))];
    default:
      throw problem(405, "Not possible", `${method} ${tail}`);
  }
}
