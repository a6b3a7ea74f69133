/** Numbers as people read them; units always stand beside them. */

const DECIMALS = new Intl.NumberFormat("en", { maximumFractionDigits: 1 });
const WHOLE = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });

/** Decimal multiples, three digits. */
export function bytes(n: number): string {
  const units = ["B", "kB", "MB", "GB", "TB"];
  let unit = 0;
  while (Math.abs(n) >= 1000 && unit < units.length - 1) {
    n /= 1000;
    unit += 1;
  }
  return `${unit === 0 || n >= 100 ? WHOLE.format(n) : DECIMALS.format(n)} ${units[unit]}`;
}

/** Whole numbers with separators. */
export const count = (n: number) => WHOLE.format(n);

/** One decimal at most. */
export const decimal = (n: number) => DECIMALS.format(n);

/** A length of time on a counter: `0:12.3`, `1:02:03`. */
export function clock(seconds: number, decimals = 1): string {
  const tenths = Math.max(0, Math.round(seconds * 10 ** decimals) / 10 ** decimals);
  const hours = Math.floor(tenths / 3600);
  const minutes = Math.floor((tenths % 3600) / 60);
  const rest = (tenths % 60).toFixed(hours ? 0 : decimals);
  const padded = rest.padStart(hours || decimals === 0 ? 2 : 3 + decimals, "0");
  return hours ? `${hours}:${String(minutes).padStart(2, "0")}:${padded}` : `${minutes}:${padded}`;
}

/** A rough length of time: `40 min`, `3.5 h`, `12 days`. */
export function duration(seconds: number): string {
  if (seconds < 90) return `${WHOLE.format(seconds)} s`;
  if (seconds < 5400) return `${WHOLE.format(seconds / 60)} min`;
  if (seconds < 172_800) return `${DECIMALS.format(seconds / 3600)} h`;
  return `${WHOLE.format(seconds / 86_400)} days`;
}

/** How many times smaller than the same scans as OBJ and BMP files. */
export const ratio = (r: number | null) => (r ? `${WHOLE.format(r)} : 1` : "–");

/** A share in percent. */
export const percent = (share: number) => `${DECIMALS.format(share * 100)} %`;

/** Millimetres, micrometre steps. */
export const mm = (x: number | null | undefined) => (x == null ? "–" : `${x.toFixed(3)} mm`);

/** A date as a person in an office writes it, in local time. */
export function date(rfc3339: string): string {
  const d = new Date(rfc3339);
  if (Number.isNaN(d.getTime())) return "–";
  const two = (n: number) => String(n).padStart(2, "0");
  return `${d.getFullYear()}-${two(d.getMonth() + 1)}-${two(d.getDate())} ${two(d.getHours())}:${two(d.getMinutes())}`;
}

/** `picture_lost` as words. */
export const words = (name: string) => name.replaceAll("_", " ");
