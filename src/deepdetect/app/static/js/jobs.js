// Tasks that run in Python: they are sent, polled for progress, and cancelled.
import { page } from "./page.js";

const ASK_EVERY_MS = 400;

/** Turns "one sentence" of the server into "One sentence." for the page. */
export const sentence = (text) => text.replace(/^./, (c) => c.toUpperCase()).replace(/[^.!?]$/, "$&.");

/** Sends a request; an error of the server is thrown with its sentence. */
async function ask(path, options = {}) {
  let response;
  try {
    response = await fetch(path, {
      ...options, headers: { "Authorization": `Bearer ${page.token}` },
    });
  } catch {
    throw new Error("The program on this computer does not answer: start deepdetect app again.");
  }
  if (!response.ok) throw new Error(sentence((await response.json()).error));
  return response;
}

/** Packs a length, a description in JSON of that length, and the files. */
function packed(files, options) {
  const list = files.map((file) => ({ name: file.webkitRelativePath || file.name, size: file.size }));
  const description = new TextEncoder().encode(JSON.stringify({ files: list, options }));
  const length = new DataView(new ArrayBuffer(4));
  length.setUint32(0, description.length);
  return new Blob([length.buffer, description, ...files]);
}

/** A running task. */
export class Task {
  /** Sends the files. @param {string} kind @param {File[]} files @param {object} options */
  static async start(kind, files, options) {
    const { file_mb: fileMb, task_mb: taskMb, files: most } = page.server.limits;
    const large = files.find((file) => file.size > fileMb * 1e6);
    if (large) throw new Error(`${large.name} is over ${fileMb} MB: use a smaller image.`);
    if (files.length > most) throw new Error(`Give at most ${most} images at once.`);
    if (files.reduce((sum, file) => sum + file.size, 0) > taskMb * 1e6) {
      throw new Error(`The images are over ${taskMb} MB together: give fewer.`);
    }
    const query = new URLSearchParams({ kind });
    const answer = await ask(`/api/jobs?${query}`, { method: "POST", body: packed(files, options) });
    return new Task((await answer.json()).job);
  }

  constructor(name) {
    this.address = `/api/jobs/${name}`;
    this.cancelled = false;
    // Closing the page removes the task.
    this.leave = () => fetch(this.address, { method: "DELETE", keepalive: true,
                                             headers: { "Authorization": `Bearer ${page.token}` } });
    addEventListener("pagehide", this.leave);
  }

  /** Waits for the result. @param {(stage: string, done: number, total: number) => void} tell */
  async result(tell) {
    while (!this.cancelled) {
      const state = await (await ask(this.address)).json();
      if (state.state === "failed") throw new Error(sentence(state.error));
      if (state.state === "done") return state;
      tell(state.stage, state.done ?? 0, state.total ?? 0);
      await new Promise((resolve) => setTimeout(resolve, ASK_EVERY_MS));
    }
    return null;
  }

  /** @returns {Promise<Blob>} one file of the result */
  async file(name) {
    return (await ask(`${this.address}/files/${name}`)).blob();
  }

  /** Ends the task and removes its files. */
  async forget() {
    this.cancelled = true;
    removeEventListener("pagehide", this.leave);
    await ask(this.address, { method: "DELETE" }).catch(() => {}); // the task may be gone already
  }
}
