// View of tasks that run in Python: guided matching, registration, panoramas, 3D models, folders.
import { Task } from "../jobs.js";
import { save } from "../downloads.js";
import { announce, element, page, showError } from "../page.js";
import { compare } from "./wipe.js";

let work = null; // the running task: its kind, and whether it was cancelled
let last = null; // the task that was started last
let given = ""; // the number that the user has entered for a task
let urls = []; // addresses of files of the displayed result

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
    const { suffixes } = page.server;
    const files = [...input.files] // the files that Python would take from a folder, in its order
      .filter(({ name, webkitRelativePath: path }) => !/\/\./.test(path)
        && suffixes.some((suffix) => name.toLowerCase().endsWith(suffix)))
      .sort((a, b) => a.webkitRelativePath.localeCompare(b.webkitRelativePath, "en", { numeric: true }));
    input.value = "";
    if (files.length) use(files);
    else showError("There are no images in this folder: choose another one.");
  };
  input.click();
}

/** Enables the tasks that can run with the present images. */
export function show() {
  element("pair-tasks").hidden = page.pictures.length === 0;
  for (const each of page.server?.tasks ?? []) {
    const button = document.querySelector(`[data-kind="${each.kind}"]`);
    const [least, most] = each.files;
    const fits = each.folder || (page.pictures.length >= least && page.pictures.length <= most);
    button.disabled = Boolean(work) || Boolean(each.missing) || !fits;
  }
}

async function run(each, files, showWipe) {
  if (work) return;
  showError("");
  clear();
  const own = { each, task: null, cancelled: false };
  work = last = own;
  const options = Number(given) > 0 && "focal_px" in each.options ? { focal_px: Number(given) } : {};
  const tell = (...told) => own.cancelled || progress(each.title, ...told);
  tell("sending the images", 0, 0);
  show();
  try {
    own.task = await Task.start(each.kind, files, options);
    const result = own.cancelled ? null : await own.task.result(tell);
    if (result) await showResult(own, result, showWipe);
  } catch (error) {
    if (!own.cancelled) showError(error.message);
  } finally {
    if (work === own) { // after a cancelled task, another one may be running
      work = null;
      end(each.kind);
    }
    await own.task?.forget();
  }
}

/** Allows the next task, and moves the keyboard focus back to the button of this one. */
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
    element("job-cancel").focus(); // the pressed button is now disabled
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
  const own = work;
  if (!own) return;
  own.cancelled = true;
  work = null;
  clear();
  end(own.each.kind);
  announce("Cancelled");
  await own.task?.forget();
}

async function showResult(own, { numbers, shown, files }, showWipe) {
  const { each, task } = own;
  // Fetch all files before the server removes them.
  const blobs = new Map();
  for (const name of new Set([shown, ...files])) blobs.set(name, await task.file(name));
  if (own.cancelled) return;
  const place = element("job-result");
  const what = shown.endsWith(".html") ? await modelFrame(`${task.address}/files/${shown}`)
                                       : picture(blobs.get(shown), each.title);
  place.replaceChildren(what);
  place.hidden = false;
  element("job-empty").hidden = true;
  if (what.loaded) await what.loaded;
  const bitmap = blobs.has("registered.png") ? await createImageBitmap(blobs.get("registered.png")) : null;
  if (own.cancelled) return;
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
  if (bitmap) offerWipe(bitmap, showWipe);
  announce(`${each.title} is done: ${Object.entries(numbers).map((pair) => pair.join(" ")).join(", ")}`);
}

/** Returns a frame with the viewer of a model; its promise `loaded` settles when it is loaded. */
function modelFrame(address) {
  const frame = document.createElement("iframe");
  frame.title = "3D model";
  frame.setAttribute("sandbox", "allow-scripts allow-downloads");
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

function offerWipe(bitmap, showWipe) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = "Compare with the first";
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

/** Ends the task of removed images and drops its result; tasks for folders stay. */
export function reset() {
  if (last?.each.folder) return show();
  cancel();
  clear();
  show();
}
