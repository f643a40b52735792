// What Python does better: matching, registration, panoramas, 3D models, folders.
import { Task } from "../jobs.js";
import { save } from "../downloads.js";
import { announce, element, page, showError } from "../page.js";
import { compare } from "./wipe.js";

const IMAGE = /\.(bmp|jpe?g|pgm|png|ppm|tiff?|webp)$/i;

let task = null; // at work
let kind = ""; // of the last task
let given = ""; // the number that a task takes
let urls = []; // of files of the result that is shown

export function setUp() {
  element("job-cancel").onclick = () => cancel();
}

/** Makes the buttons of the tasks that the server offers. */
export function offer(showWipe) {
  for (const [place, folder] of [["job-kinds", false], ["folder-kinds", true]]) {
    const tasks = page.server.tasks.filter((each) => each.folder === folder);
    element(place).replaceChildren(...tasks.flatMap((each) => {
      const button = document.createElement("button");
      button.type = "button";
      button.dataset.kind = each.kind;
      const note = document.createElement("small");
      note.textContent = each.missing ? `needs ${each.missing}` : each.note;
      button.append(each.title, note);
      button.onclick = () => (folder ? askForFolder((files) => run(each, files, showWipe))
                                     : run(each, page.pictures.map(({ file }) => file), showWipe));
      return [button, ...Object.entries(each.options).map(([name, text]) => numberInput(name, text))];
    }));
  }
}

function numberInput(name, text) {
  const label = document.createElement("label");
  label.className = "number";
  const input = document.createElement("input");
  input.type = "number";
  input.min = "1";
  input.max = "100000";
  input.step = "any";
  input.name = name;
  input.oninput = () => {
    given = input.value;
  };
  label.append(text, input);
  return label;
}

function askForFolder(use) {
  const input = element("folder");
  input.onchange = () => {
    const files = [...input.files].filter((file) => IMAGE.test(file.name))
      .sort((a, b) => a.webkitRelativePath.localeCompare(b.webkitRelativePath));
    input.value = "";
    if (files.length) use(files);
    else showError("There is no picture in this folder: choose another one.");
  };
  input.click();
}

/** Says which tasks can be done with the pictures that are there. */
export function show() {
  element("pair-tasks").hidden = page.pictures.length === 0;
  for (const each of page.server?.tasks ?? []) {
    const button = document.querySelector(`[data-kind="${each.kind}"]`);
    const [least, most] = each.files;
    const fits = each.folder || (page.pictures.length >= least && page.pictures.length <= most);
    button.disabled = Boolean(task) || Boolean(each.missing) || !fits;
  }
}

async function run(each, files, showWipe) {
  if (task) return;
  showError("");
  clear();
  kind = each.kind;
  const options = Number(given) > 0 && "focal_px" in each.options ? { focal_px: Number(given) } : {};
  progress(each.title, "sending the pictures", 0, 0);
  try {
    task = "sending";
    show();
    const started = await Task.start(each.kind, files, options);
    if (task !== "sending") return await started.forget(); // it was cancelled meanwhile
    task = started;
    const result = await task.result((...told) => progress(each.title, ...told));
    if (result) await showResult(each, result, files, showWipe);
  } catch (error) {
    showError(error.message);
  } finally {
    const ended = task;
    task = null;
    if (!element("job-progress").hidden) end(each.kind);
    if (ended?.forget) await ended.forget();
  }
}

/** Lets the next task begin; those who use the keyboard are back where they were. */
function end(kind) {
  const focused = element("job-progress").contains(document.activeElement);
  element("job-progress").hidden = true;
  element("job-empty").hidden = !element("job-result").hidden;
  show();
  if (focused) document.querySelector(`[data-kind="${kind}"]`).focus();
}

function progress(title, stage, done, total) {
  if (element("job-progress").hidden) {
    element("job-progress").hidden = false;
    element("job-empty").hidden = true;
    element("job-cancel").focus(); // the button that was pressed can no longer be
  }
  const text = `${title}: ${stage}`;
  if (element("job-stage").textContent !== text) announce(text);
  element("job-stage").textContent = text;
  const bar = element("job-bar");
  if (total) {
    bar.max = total;
    bar.value = done;
  } else {
    bar.removeAttribute("value");
  }
}

async function cancel() {
  const ended = task;
  task = null;
  end(kind);
  if (ended?.forget) await ended.forget();
  announce("Cancelled");
}

async function showResult(each, { numbers, shown, files }, sent, showWipe) {
  // All files are fetched before the server forgets them.
  const blobs = new Map();
  for (const name of new Set([shown, ...files])) blobs.set(name, await task.file(name));
  const place = element("job-result");
  const what = shown.endsWith(".html") ? await modelFrame(`${task.address}/files/${shown}`)
                                       : picture(blobs.get(shown), each.title);
  place.replaceChildren(what);
  place.hidden = false;
  element("job-empty").hidden = true;
  if (what.loaded) await what.loaded;
  element("job-numbers").replaceChildren(...Object.entries(numbers).flatMap(([name, text]) => {
    const [term, value] = [document.createElement("dt"), document.createElement("dd")];
    [term.textContent, value.textContent] = [name, text];
    return [term, value];
  }));
  const label = document.createElement("span");
  label.textContent = "Download";
  element("job-files").replaceChildren(label, ...files.map((name) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = name;
    button.onclick = () => save(name, blobs.get(name));
    return button;
  }));
  element("job-summary").hidden = false;
  if (blobs.has("registered.png")) await offerWipe(blobs.get("registered.png"), showWipe);
  announce(`${each.title} is done: ${Object.entries(numbers).map((pair) => pair.join(" ")).join(", ")}`);
}

/** The viewer of a model in a frame of its own; the promise holds when it is there. */
function modelFrame(address) {
  const frame = document.createElement("iframe");
  frame.title = "3D model";
  frame.setAttribute("sandbox", "allow-scripts");
  frame.loaded = new Promise((resolve) => {
    frame.onload = resolve;
  });
  frame.src = address;
  return frame;
}

function picture(blob, title) {
  const image = new Image();
  const url = URL.createObjectURL(blob);
  urls.push(url);
  image.src = url;
  image.alt = `Result: ${title}`;
  return image;
}

async function offerWipe(blob, showWipe) {
  const bitmap = await createImageBitmap(blob);
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "Compare in Wipe";
  button.onclick = () => {
    compare(bitmap);
    showWipe();
  };
  element("job-files").append(button);
}

function clear() {
  for (const url of urls) URL.revokeObjectURL(url);
  urls = [];
  element("job-result").replaceChildren();
  element("job-result").hidden = true;
  element("job-empty").hidden = false;
  element("job-summary").hidden = true;
  element("job-files").replaceChildren();
  element("job-numbers").replaceChildren();
}

/** Forgets the result of pictures that are gone. */
export function reset() {
  clear();
  show();
}
