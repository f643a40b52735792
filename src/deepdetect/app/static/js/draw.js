// Drawing of images, keypoints, heat maps and matches on canvases.

const VIRIDIS = [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142],
                 [31, 158, 137], [53, 183, 121], [109, 205, 89], [180, 222, 44], [253, 231, 37]];
const MARK = [60, 255, 60];
const DIMMED = 0.5;
const MAX_LINES = 200; // number of matches drawn, evenly chosen: more cannot be distinguished
const MAX_CIRCLES = 5000; // more keypoints than this are drawn as single pixels
const STRIP_RATIO = 8; // longer images are not fitted to the page, where they would be too thin
const MAX_HEIGHT_PER_WIDTH = 4; // bounds the height of drawn matches, as browsers limit canvases

export function newCanvas(width, height) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = height;
  return canvas;
}

/** @param {Uint8ClampedArray} rgba */
export function canvasOf(rgba, width, height) {
  const canvas = newCanvas(width, height);
  canvas.getContext("2d").putImageData(new ImageData(rgba, width, height), 0, 0);
  return canvas;
}

/** Shows an image below its overlay; long strips keep their own size, so that one can scroll. */
export function showPicture(canvas, picture) {
  if (canvas.source === picture) return;
  canvas.source = picture;
  [canvas.width, canvas.height] = [picture.width, picture.height];
  canvas.getContext("2d").drawImage(picture.canvas, 0, 0);
  const [short, long] = [picture.width, picture.height].sort((a, b) => a - b);
  canvas.parentElement.classList.toggle("strip", long > STRIP_RATIO * short);
}

function resized(canvas, width, height) {
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  return canvas.getContext("2d");
}

/** Colours of the levels 0 to 255. */
const COLORS = Array.from({ length: 256 }, (_, level) => {
  const place = level / 255 * (VIRIDIS.length - 1);
  const low = Math.min(Math.floor(place), VIRIDIS.length - 2);
  return VIRIDIS[low].map((value, c) => value + (place - low) * (VIRIDIS[low + 1][c] - value));
});

/** Draws probabilities as colours, from dark blue (0) to yellow (1). */
export function drawHeatMap(canvas, map) {
  const context = resized(canvas, map.width, map.height);
  const image = context.createImageData(map.width, map.height);
  map.probability.forEach((value, k) => {
    const color = COLORS[Math.round(255 * value)];
    for (let c = 0; c < 3; c++) image.data[4 * k + c] = color[c];
    image.data[4 * k + 3] = 255;
  });
  context.putImageData(image, 0, 0);
}

/**
 * Marks pixels on a transparent canvas.
 *
 * @param {ArrayLike<number>} pixels numbered row by row
 */
export function drawPixels(canvas, picture, pixels) {
  const context = resized(canvas, picture.width, picture.height);
  const image = context.createImageData(picture.width, picture.height);
  const words = new Uint32Array(image.data.buffer);
  const mark = new Uint32Array(new Uint8Array([...MARK, 150]).buffer)[0];
  for (let k = 0; k < pixels.length; k++) words[pixels[k]] = mark;
  context.putImageData(image, 0, 0);
}

/**
 * Draws keypoints on a transparent canvas: a few as circles, many as pixels.
 *
 * @param {Float32Array} xy
 * @param {(k: number) => number} radiusOf in pixels of the image
 * @param {number} unit pixels of the image per pixel of the screen
 */
export function drawCircles(canvas, picture, xy, radiusOf, unit) {
  const count = xy.length / 2;
  if (count > MAX_CIRCLES) {
    const nearest = (k) => Math.round(xy[2 * k + 1]) * picture.width + Math.round(xy[2 * k]);
    drawPixels(canvas, picture, Uint32Array.from({ length: count }, (_, k) => nearest(k)));
    return;
  }
  const context = resized(canvas, picture.width, picture.height);
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.beginPath();
  for (let k = 0; k < count; k++) {
    const [x, y] = [xy[2 * k] + 0.5, xy[2 * k + 1] + 0.5]; // the origin of a canvas is the corner
    context.moveTo(x + radiusOf(k), y);
    context.arc(x, y, radiusOf(k), 0, 2 * Math.PI);
  }
  context.lineWidth = 1.2 * unit;
  context.strokeStyle = `rgb(${MARK})`;
  context.stroke();
}

/** Returns the dimmed image with its keypoints, to be saved as PNG. */
export function composeKeypoints(picture, overlay) {
  const canvas = newCanvas(picture.width, picture.height);
  const context = canvas.getContext("2d");
  context.drawImage(picture.canvas, 0, 0);
  context.fillStyle = `rgba(0, 0, 0, ${1 - DIMMED})`;
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.drawImage(overlay, 0, 0);
  return canvas;
}

/**
 * Draws two images side by side or stacked, and lines between their matches.
 *
 * @param {boolean[] | Uint8Array} good matches to draw in colours; others are red
 * @param {number | null} hovered the highlighted match
 * @returns {Line[]} lines that are drawn
 *
 * @typedef {{k: number, from: [number, number], to: [number, number]}} Line in pixels of the canvas
 */
export function drawMatches(canvas, pictures, points0, points1, good,
                            { stacked, width, thickness, hovered = null }) {
  const gap = 8;
  const [first, second] = pictures;
  const [widths, heights] = [[first.width, second.width], [first.height, second.height]];
  const [across, down] = stacked ? [Math.max(...widths), heights[0] + heights[1]]
                                 : [widths[0] + widths[1], Math.max(...heights)];
  const scale = Math.min((stacked ? width : width - gap) / across, MAX_HEIGHT_PER_WIDTH * width / down);
  const corner = stacked ? [0, Math.round(first.height * scale) + gap]
                         : [Math.round(first.width * scale) + gap, 0];
  const size = [Math.round(across * scale) + (stacked ? 0 : gap),
                Math.round(down * scale) + (stacked ? gap : 0)].map((side) => Math.max(1, side));
  const context = resized(canvas, ...size);
  context.clearRect(0, 0, canvas.width, canvas.height);
  context.drawImage(first.canvas, 0, 0, first.width * scale, first.height * scale);
  context.drawImage(second.canvas, ...corner, second.width * scale, second.height * scale);
  const place = (points, k, [left, top]) => [(points[2 * k] + 0.5) * scale + left,
                                             (points[2 * k + 1] + 0.5) * scale + top];
  const step = Math.max(1, good.length / MAX_LINES);
  const lines = Array.from({ length: Math.min(good.length, MAX_LINES) }, (_, line) => {
    const k = Math.floor(line * step);
    return { k, from: place(points0, k, [0, 0]), to: place(points1, k, corner) };
  });
  const draw = ({ k, from, to }) => {
    // Neighbouring matches have similar colours, so that an outlier stands out.
    const hue = 360 * points0[2 * k] / first.width;
    context.strokeStyle = good[k] ? `hsl(${hue} 95% ${45 + 25 * points0[2 * k + 1] / first.height}%)`
                                  : "rgba(230, 40, 40, 0.55)";
    context.beginPath();
    context.moveTo(...from);
    context.lineTo(...to);
    context.stroke();
  };
  const isHovered = ({ k }) => k === hovered;
  context.lineWidth = thickness;
  context.globalAlpha = lines.some(isHovered) ? 0.15 : 0.9;
  for (const wanted of [false, true]) {
    for (const line of lines) if (Boolean(good[line.k]) === wanted) draw(line);
  }
  context.globalAlpha = 1;
  for (const line of lines.filter(isHovered)) {
    context.lineWidth = 2 * thickness;
    draw(line);
    for (const end of [line.from, line.to]) {
      context.beginPath();
      context.arc(...end, 5 * thickness, 0, 2 * Math.PI);
      context.stroke();
    }
  }
  return lines;
}

/** Returns the match whose line is nearest to a position, or null beyond the reach. @param {Line[]} lines */
export function nearestLine(lines, x, y, reach) {
  let [nearest, least] = [null, reach];
  for (const { k, from, to } of lines) {
    const [across, down] = [to[0] - from[0], to[1] - from[1]];
    const along = ((x - from[0]) * across + (y - from[1]) * down) / (across ** 2 + down ** 2 || 1);
    const share = Math.max(0, Math.min(1, along));
    const distance = Math.hypot(from[0] + share * across - x, from[1] + share * down - y);
    if (distance < least) [nearest, least] = [k, distance];
  }
  return nearest;
}
