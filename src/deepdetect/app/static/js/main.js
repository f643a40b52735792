// The page: it takes images, chooses the view, and opens the runtime of the network.
import { isOpened, openNetwork, readPicture } from "./detection.js";
import { canvasOf, newCanvas } from "./draw.js";
import { activePicture, counted, during, element, page, showError } from "./page.js";
import * as heatmap from "./views/heatmap.js";
import * as keypoints from "./views/keypoints.js";
import * as matches from "./views/matches.js";
import * as python from "./views/python.js";
import * as wipe from "./views/wipe.js";

const MAX_PICTURES = 2;
const VIEWS = {
  keypoints: { show: keypoints.show },
  heatmap: { show: heatmap.show },
  matches: { show: async () => { matches.draw(); await matches.match(); matches.draw(); } },
  wipe: { show: wipe.prepare },
  python: { show: python.show },
};

let current = "keypoints";

/** Number of restarts: an image that was being read before one is not added. */
let restarts = 0;

/** Message for images that are given before the network is opened. */
let unready = "The page could not be loaded completely: load it again.";

async function start() {
  const config = await (await fetch("config.json")).json();
  page.server = config.engine === "python" ? config : null;
  const alone = page.server === null;
  page.token = alone ? "" : takeToken();
  for (const part of document.querySelectorAll(".with-python")) part.hidden = alone;
  for (const part of document.querySelectorAll(".without-python")) part.hidden = !alone;
  element("tab-python").hidden = alone;
  element("use-folder").hidden = !page.token;
  element("power").textContent = alone ? "In this browser" : "With Python";
  element("promise").textContent = alone
    ? "Your images stay on this device: the network runs in this browser."
    : "Your images stay on this computer, and are removed after each task.";
  if (!alone && !page.token) {
    unready = "Open the address that deepdetect app printed: it ends in a key.";
    showError(unready);
    return;
  }
  if (!alone) python.offer(() => showView("wipe"));
  if (alone && "serviceWorker" in navigator && config.offline) {
    navigator.serviceWorker.register("sw.js").catch(() => {}); // without it, the page works only online
  }
  const open = (processor) => openNetwork({ engine: config.engine, token: page.token, processor });
  open("processor").then(sayWhere, (error) => showError(error.message));
  await showExamples();
  if (!config.webgpu) return;
  hasGraphics().then((found) => { if (found) offerGraphics(() => open("graphics")); }); // not awaited
}

function sayWhere(words) {
  element("engine").textContent = `The network runs ${words}.`;
}

/** @returns {Promise<boolean>} whether networks can run on a graphics card */
async function hasGraphics() {
  return Boolean(await navigator.gpu?.requestAdapter().catch(() => null));
}

/** Offers to run the network on the graphics card, from the next image on. */
function offerGraphics(open) {
  const button = element("graphics");
  button.hidden = false;
  button.onclick = () => guarded(async () => {
    sayWhere(await during("Loading the network…", open()));
    button.hidden = true;
  });
}

/** Takes the key of this start, and removes it from the address, so that nobody copies it. */
function takeToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("key");
  if (given) {
    sessionStorage.setItem("key", given);
    history.replaceState(null, "", location.pathname + location.search);
  }
  return sessionStorage.getItem("key") ?? "";
}

/** Takes the key of a new start, whose address differs only in the key, and reloads the page. */
function takeNewToken() {
  const old = page.token;
  if (page.server && takeToken() !== old) location.reload();
}

async function showExamples() {
  const examples = await (await fetch("examples/examples.json")).json();
  element("examples").replaceChildren(...examples.map(({ title, note, files }) => {
    const item = document.createElement("li");
    const button = document.createElement("button");
    button.type = "button";
    const image = new Image();
    image.src = `examples/${files[files.length - 1]}`;
    image.alt = "";
    const [name, small] = [document.createElement("span"), document.createElement("small")];
    [name.textContent, small.textContent] = [title, note];
    button.append(image, name, small);
    button.onclick = () => guarded(async () => addPictures(await Promise.all(files.map(async (file) => {
      const response = await fetch(`examples/${file}`);
      return new File([await response.blob()], file, { type: "image/jpeg" });
    }))));
    item.append(button);
    return item;
  }));
}

/** Runs a task and shows the message of its error. */
async function guarded(task) {
  showError("");
  try {
    await task();
  } catch (error) {
    showError(error.message);
  }
}

/** Reads files and adds them as images; the view then computes what it shows. */
async function addPictures(files) {
  await starting; // images may come before the network is opened
  if (!isOpened()) throw new Error(unready);
  const room = MAX_PICTURES - page.pictures.length;
  if (files.length > room) {
    const advice = page.server ? " or use a folder under “3D, panorama, folder”." : ".";
    throw new Error(room ? `Give at most ${counted(room, "image")}${advice}`
                         : "There are already two images: remove one, or start over.");
  }
  const started = restarts;
  for (const file of files) {
    let read;
    try {
      read = await readPicture(file);
    } catch (error) {
      if (restarts !== started) return;
      if (page.pictures.length) showView(current); // shows the images read before
      throw error;
    }
    if (restarts !== started) return;
    if (page.pictures.length >= MAX_PICTURES) return; // another call has added one meanwhile
    page.pictures.push({ name: file.name, file, ...read, removal: new AbortController(),
                         canvas: canvasOf(read.rgba, read.width, read.height) });
    if (file === files.at(-1)) break;
    page.active = page.pictures.length - 1;
    listPictures();
    keypoints.preview();
  }
  page.active = 0;
  if (page.pictures.length === 2 && current === "keypoints") current = "matches";
  listPictures();
  await showView(current);
}

function removePicture(picture) {
  picture.removal.abort();
  page.pictures = page.pictures.filter((other) => other !== picture);
  page.active = 0;
  showPictures();
  focusStart();
}

/** Moves the focus to a start button, because the pressed button is gone. */
function focusStart() {
  const next = page.pictures.length ? element("add") : element("start").querySelector("button");
  next.focus();
}

/** Shows the chosen view of the present images. */
function showPictures() {
  listPictures();
  if (page.pictures.length) guarded(VIEWS[current].show);
}

/** Lists the present images, and drops results of others. */
function listPictures() {
  const { pictures } = page;
  matches.reset();
  wipe.reset();
  python.reset();
  element("start").hidden = pictures.length > 0;
  element("work").hidden = pictures.length === 0;
  element("add").hidden = pictures.length >= MAX_PICTURES;
  for (const button of document.querySelectorAll('.files [data-action="camera"]')) {
    button.hidden = pictures.length >= MAX_PICTURES || !hasCamera();
  }
  for (const group of document.querySelectorAll(".which")) {
    group.hidden = pictures.length < 2;
    group.querySelectorAll("input")[page.active].checked = true;
  }
  element("files").replaceChildren(...pictures.map(pictureItem));
  element("add").textContent = pictures.length ? "Add a second image" : "Add images";
}

function pictureItem(picture) {
  const item = document.createElement("li");
  const small = newCanvas(80, 64);
  const scale = Math.max(80 / picture.width, 64 / picture.height);
  small.getContext("2d").drawImage(picture.canvas, 0, 0, picture.width * scale,
                                   picture.height * scale);
  small.setAttribute("aria-hidden", "true");
  const [name, size] = [document.createElement("b"), document.createElement("small")];
  name.textContent = picture.name;
  name.title = picture.name;
  const { width, height } = picture.original;
  const reduced = width !== picture.width || height !== picture.height;
  size.textContent = `${width}×${height}${reduced ? `, scaled to ${picture.width}×${picture.height}` : ""}`;
  const remove = document.createElement("button");
  remove.type = "button";
  remove.className = "quiet remove";
  remove.textContent = "Remove";
  remove.setAttribute("aria-label", `Remove ${picture.name}`);
  remove.onclick = () => removePicture(picture);
  item.append(small, name, size, remove);
  return item;
}

async function showView(name) {
  if (!page.pictures.length && name !== "python") showPictures(); // shows the start
  current = name;
  for (const tab of element("tabs").children) {
    const chosen = tab.id === `tab-${name}`;
    tab.setAttribute("aria-selected", String(chosen));
    tab.tabIndex = chosen ? 0 : -1;
    element(tab.getAttribute("aria-controls")).hidden = !chosen;
  }
  for (const group of document.querySelectorAll(".which")) {
    group.querySelectorAll("input")[page.active].checked = true;
  }
  if (activePicture() || name === "python") await guarded(VIEWS[name].show);
}

const hasCamera = () => matchMedia("(pointer: coarse)").matches;

function setUp() {
  for (const view of [keypoints, heatmap, matches, wipe, python]) view.setUp();
  for (const form of document.querySelectorAll("form")) {
    form.addEventListener("submit", (event) => event.preventDefault());
  }
  const take = (input) => {
    input.onchange = () => {
      const files = [...input.files];
      input.value = "";
      if (files.length) guarded(() => addPictures(files));
    };
  };
  take(element("file"));
  take(element("shot"));
  for (const button of document.querySelectorAll('[data-action="choose"]')) {
    button.onclick = () => element("file").click();
  }
  for (const button of document.querySelectorAll('[data-action="camera"]')) {
    button.hidden = !hasCamera();
    button.onclick = () => element("shot").click();
  }
  element("use-folder").onclick = () => {
    [element("start").hidden, element("work").hidden] = [true, false];
    showView("python");
  };
  element("restart").onclick = () => {
    for (const { removal } of page.pictures) removal.abort();
    page.pictures = [];
    restarts++;
    showError("");
    showView("keypoints");
    focusStart();
  };
  element("error").querySelector("button").onclick = () => showError("");
  setUpTabs();
  setUpDropping();
  addEventListener("hashchange", takeNewToken);
}

function setUpTabs() {
  const tabs = element("tabs");
  tabs.addEventListener("click", (event) => {
    const tab = event.target.closest("[role=tab]");
    if (tab) showView(tab.id.replace("tab-", ""));
  });
  tabs.addEventListener("keydown", (event) => {
    const shown = [...tabs.children].filter((tab) => !tab.hidden);
    const place = shown.findIndex((tab) => tab.id === `tab-${current}`);
    const moves = { ArrowRight: place + 1, ArrowLeft: place - 1, Home: 0, End: shown.length - 1 };
    if (!(event.key in moves)) return;
    event.preventDefault();
    const next = shown[(moves[event.key] + shown.length) % shown.length];
    next.focus();
    next.click();
  });
}

function setUpDropping() {
  addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("dragging");
  });
  addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) document.body.classList.remove("dragging");
  });
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dragging");
    const files = [...event.dataTransfer.files];
    if (files.length) guarded(() => addPictures(files));
  });
  addEventListener("paste", (event) => {
    const files = [...(event.clipboardData?.files ?? [])];
    if (files.length) guarded(() => addPictures(files));
  });
}

setUp();
showView("keypoints");
const starting = start()
  .catch(() => showError(unready));
