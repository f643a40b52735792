// Files that the user keeps: CSV as `deepdetect` writes it, JSON, and PNG.

const DIGITS = 7; // of a number: those of float32

/** A number as Python's "%.7g" writes it, but for exponents. */
const written = (value) => String(Number(value.toPrecision(DIGITS)));

/** Rows of numbers, with a header as `deepdetect detect --format csv` writes it. */
export function toCsv(header, rows) {
  return [header, ...rows.map((row) => row.map(written).join(","))].join("\n") + "\n";
}

export function toJson(values) {
  return JSON.stringify(values, (_, value) => (typeof value === "number" ? Number(written(value)) : value), 1) + "\n";
}

/** Hands a file to the browser. @param {Blob | string} content */
export function save(name, content, type = "text/plain") {
  const url = URL.createObjectURL(content instanceof Blob ? content : new Blob([content], { type }));
  const link = document.createElement("a");
  link.href = url;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

/** @param {HTMLCanvasElement} canvas */
export async function savePng(name, canvas) {
  const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
  if (!blob) throw new Error("The picture is too large for this browser to save: use a smaller one.");
  save(name, blob);
}

/** The name of a file without its folder and ending. */
export const stem = (name) => name.replace(/^.*[\\/]/, "").replace(/\.[^.]*$/, "") || "picture";
