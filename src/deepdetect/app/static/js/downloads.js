// Files to download: CSV as `deepdetect` writes it, JSON, PNG, and video.

const DIGITS = 7; // significant digits, as in float32

/** Formats a number as Python's "%.7g" does, except for exponents. */
const written = (value) => String(Number(value.toPrecision(DIGITS)));

/** Formats rows of numbers with a header, as `deepdetect detect --format csv` does. */
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
  if (!blob) throw new Error("The image is too large for this browser to save: use a smaller one.");
  save(name, blob);
}

/**
 * Saves an animation on a canvas, of some seconds, as a video.
 *
 * @param {HTMLCanvasElement} canvas @param {(progress: number) => void} drawAt from 0 to 1
 */
export async function saveVideo(name, canvas, seconds, drawAt) {
  if (!canvas.captureStream || typeof MediaRecorder === "undefined") {
    throw new Error("This browser cannot record videos: save the image, or use another browser.");
  }
  const recorder = new MediaRecorder(canvas.captureStream());
  const parts = [];
  recorder.ondataavailable = ({ data }) => parts.push(data);
  const stopped = new Promise((resolve) => { recorder.onstop = resolve; });
  recorder.start();
  const begin = performance.now();
  for (let progress = 0; progress < 1;) {
    const now = await new Promise(requestAnimationFrame);
    progress = Math.min(1, Math.max(0, (now - begin) / (1000 * seconds)));
    drawAt(progress);
  }
  recorder.stop();
  await stopped;
  const type = recorder.mimeType;
  save(`${name}.${type.includes("mp4") ? "mp4" : "webm"}`, new Blob(parts, { type }));
}

/** Returns the name of a file without its folder and suffix. */
export const stem = (name) => name.replace(/^.*[\\/]/, "").replace(/\.[^.]*$/, "") || "picture";
