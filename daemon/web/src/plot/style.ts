/** Colours of the series (M. Okabe and K. Ito, 2008: told apart by all eyes), dark enough for white paper. */
const COLOURS = ["#0072b2", "#d55e00", "#00805c", "#a3467f", "#2a6f97", "#8c6d00", "#444444", "#7a4d9c"];

/** Style of a plot that was downloaded: it stands alone, on white. */
export const PLOT_STYLE = [
  "text{font:12px system-ui,sans-serif;fill:#222}",
  ".grid{stroke:#ddd;stroke-width:1}",
  ".axis{stroke:#444;fill:none}",
  ".curve{fill:none;stroke-width:1.5}",
  ...COLOURS.map((c, k) => `.series-${k} .curve{stroke:${c}}.series-${k} .mark{fill:${c}}`),
].join("");
