/** Made-up reports, in the form of `gv3 sweep` and `gv3 measure --json`. */

function errors(rms) {
  return { rms, p95: 1.6 * rms, p99: 2.6 * rms, max: 9 * rms };
}

function sweepPoint(setting, rate, rms) {
  const surface = { all: errors(rms), keyframes: errors(rms), in_between: errors(rms) };
  return {
    setting,
    bytes_per_scan: rate,
    rms_mm: rms,
    max_mm: 9 * rms,
    encode_ms_per_scan: 70 + 0.002 * rate,
    decode_ms_per_scan: 30,
    distortion: {
      surface_mm: { scan_to_replay: surface, replay_to_scan: surface },
      d1_psnr_db: 20 * Math.log10(300 / rms),
      d2_psnr_db: 20 * Math.log10(400 / rms),
    },
  };
}

const curve = (coder, about, rates, unavailable = null) => ({
  coder,
  about,
  unavailable,
  points: rates.map(([s, r, e]) => sweepPoint(s, r, e)),
});

export const SWEEP = {
  input: "generated-face",
  scans: 90,
  obj_bmp_bytes_per_scan: 14e6,
  curves: [
    curve("gv3", "default", [
      ["0.05 mm", 2900, 0.061],
      ["0.1 mm", 1610, 0.104],
      ["0.2 mm", 900, 0.19],
      ["0.4 mm", 610, 0.33],
    ]),
    curve("gv3 seed", "published scheme", [
      ["high", 14000, 0.31],
      ["middle", 8200, 0.6],
      ["low", 4300, 0.93],
    ]),
    curve("Draco", "every scan alone", [
      ["12 bit", 152000, 0.05],
      ["11 bit", 121000, 0.1],
      ["10 bit", 96000, 0.2],
    ]),
    curve("HEVC depth", "12-bit depth video", [], "ffmpeg was not found"),
  ],
  bd_rates: [
    { test: "gv3", anchor: "Draco", percent: -98.6 },
    { test: "Draco", anchor: "gv3", percent: 7040 },
  ],
};

export const MEASURE = {
  scans: 90,
  keyframes: 10,
  surface_mm: { scan_to_replay: { all: errors(0.1) }, replay_to_scan: { all: errors(0.09) } },
  bytes: { session: 145_420 },
  percent_of_raw: { obj_bmp: 0.011, binary: 0.038 },
  curve: Array.from({ length: 90 }, (_, tick) => {
    const rms = 0.09 + 0.015 * Math.abs(Math.sin((tick * Math.PI) / 10));
    return {
      tick,
      time_s: tick / 30,
      is_key: tick % 10 === 0,
      scan_to_replay_rms_mm: rms,
      replay_to_scan_rms_mm: rms * 0.92,
      scan_to_replay_p95_mm: rms * 1.6,
      replay_to_scan_p95_mm: rms * 1.5,
      max_mm: rms * 8,
      texture_psnr_db: tick % 10 === 0 ? 38 : 35.5 + Math.sin(tick),
    };
  }),
};

/** Distances between two sessions of so many scans. */
export function compareReport(scans) {
  const ticks = Array.from({ length: scans }, (_, k) => k);
  const rms_mm = ticks.map((t) => 0.12 + 0.03 * Math.sin(t / 7));
  const p95_mm = rms_mm.map((r) => r * 1.7);
  return { ticks, rms_mm, p95_mm, rms_mm_all: 0.121, p95_mm_all: 0.207 };
}
