// Small drawings beside the map: the heading rose, the depth of the last minutes, how a variable was learnt.

import { blank, palette } from "./look.js";

const DEG = Math.PI / 180;
export const DEPTH_S = 600; // of the depth's curve
const LEAST_SPAN_M = 2; // from its top to its bottom
const POINTS = { 0: "N", 90: "E", 180: "S", 270: "W" };

// The card turns below a fixed mark, what is ahead is up. The wedge is one sd to either side, the blue arrow points home.
export function rose(canvas, yaw, sd, home) {
  const [c, width, height] = blank(canvas);
  const r = Math.min(width, height) / 2 - 14;
  if (r <= 20) return;
  c.translate(width / 2, height / 2 + 5);
  c.textAlign = "center";
  c.textBaseline = "middle";
  const along = (angle, radius) => [radius * Math.sin(angle), -radius * Math.cos(angle)];
  if (sd !== null) {
    const half = Math.min(Math.PI, Math.max(sd, 0.5 * DEG));
    c.beginPath();
    c.arc(0, 0, r, -Math.PI / 2 - half, -Math.PI / 2 + half);
    c.arc(0, 0, r - 32, -Math.PI / 2 + half, -Math.PI / 2 - half, true);
    c.closePath();
    c.globalAlpha = 0.3;
    c.fillStyle = palette.sure;
    c.fill();
    c.globalAlpha = 1;
  }
  c.strokeStyle = c.fillStyle = palette.ink;
  c.lineWidth = 2;
  c.beginPath();
  c.arc(0, 0, r, 0, 2 * Math.PI);
  c.stroke();
  for (let degrees = 0; degrees < 360; degrees += 10) {
    const angle = degrees * DEG - yaw;
    const long = degrees % 30 === 0;
    c.lineWidth = long ? 2.5 : 1.5;
    c.beginPath();
    c.moveTo(...along(angle, r));
    c.lineTo(...along(angle, r - (long ? 11 : 6)));
    c.stroke();
    const letter = POINTS[degrees];
    if (!letter && !(long && r > 80)) continue;
    c.font = letter ? "700 18px system-ui, sans-serif" : "12px system-ui, sans-serif";
    c.fillStyle = letter === "N" ? palette.bad : palette.ink;
    c.fillText(letter ?? `${degrees}`, ...along(angle, r - 21));
  }
  arrow(c, palette.ink, [[0, -r + 1], [9, -r - 14], [-9, -r - 14]]);
  if (home === null) return;
  c.rotate(home - yaw);
  arrow(c, palette.sure, [[0, -r - 10], [11, -r + 12], [0, -r + 6], [-11, -r + 12]]);
}

function arrow(c, colour, corners) {
  c.beginPath();
  for (const corner of corners) c.lineTo(...corner);
  c.closePath();
  c.fillStyle = colour;
  c.fill();
  c.strokeStyle = palette.paper;
  c.lineWidth = 1.5;
  c.stroke();
}

// A step between lines, 1, 2 or 5 of a power of ten, of at least so much.
export function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= least);
}

// Depth of the bottom by the last minutes' altitudes, a point a second; null where there is none.
export class Bottom {
  constructor() { this.points = []; }

  add(time, down, altitude) {
    if (this.points.length && time < this.points.at(-1)[0]) this.points = []; // another dive
    if (this.points.length && time < this.points.at(-1)[0] + 1) return;
    this.points.push([time, altitude === null ? null : down + altitude]);
    this.points.splice(0, this.points.findIndex(([then]) => then >= time - DEPTH_S));
  }
}

// North and east of the current against depth, with a band of one sd; the vehicle's depth is a line across.
export function currentCurve(canvas, layers, depth) {
  const [c, width, height] = blank(canvas);
  const [left, bottom] = [38, height - 18];
  const depths = [...layers.map((layer) => layer.depth), depth];
  const [top, deep] = [Math.min(...depths), Math.max(...depths)];
  const fastest = Math.max(0.05, ...layers.flatMap((layer) => [Math.abs(layer.north), Math.abs(layer.east)]));
  const x = (value) => left + (width - left) * (0.5 + (0.45 * Math.max(-1, Math.min(1, value / fastest))));
  const y = (value) => 6 + ((value - top) / Math.max(deep - top, 1)) * (bottom - 12);
  c.font = "13px system-ui, sans-serif";
  c.textBaseline = "middle";
  c.strokeStyle = palette.grid;
  c.fillStyle = palette.soft;
  c.lineWidth = 1;
  c.textAlign = "right";
  for (const value of [top, deep]) c.fillText(`${+value.toPrecision(3)}`, left - 5, y(value));
  c.textAlign = "center";
  for (const value of [-fastest, 0, fastest]) c.fillText(value.toFixed(2), Math.min(x(value), width - 16), height - 7);
  c.beginPath();
  c.moveTo(x(0), 0);
  c.lineTo(x(0), bottom);
  c.moveTo(left, y(depth));
  c.lineTo(width, y(depth));
  c.stroke();
  for (const [axis, dash] of [["north", []], ["east", [5, 4]]]) {
    c.beginPath();
    for (const layer of layers) c.lineTo(x(layer[axis] - layer[`${axis}_sd`]), y(layer.depth));
    for (const layer of [...layers].reverse()) c.lineTo(x(layer[axis] + layer[`${axis}_sd`]), y(layer.depth));
    c.globalAlpha = 0.15;
    c.fillStyle = palette.sure;
    c.fill();
    c.globalAlpha = 1;
    c.beginPath();
    for (const layer of layers) c.lineTo(x(layer[axis]), y(layer.depth));
    c.setLineDash(dash);
    c.strokeStyle = palette.sure;
    c.lineWidth = 2;
    c.stroke();
    c.setLineDash([]);
  }
}

// Deep is below; the newest stands at the right. The bottom is dashed.
export function depthCurve(canvas, track, now, down, bed) {
  const [c, width, height] = blank(canvas);
  const [left, bottom] = [38, height - 18];
  const points = [...track.since(now - DEPTH_S), [now, down]];
  const all = [...points, ...bed].map((point) => point[1]).filter((value) => value !== null);
  const [low, high] = [Math.min(...all), Math.max(...all)];
  const spare = Math.max(0.1 * (high - low), (LEAST_SPAN_M - (high - low)) / 2);
  const [top, deep] = [low - spare, high + spare];
  const x = (time) => width - 4 - ((now - time) / DEPTH_S) * (width - left - 4);
  const y = (value) => 6 + ((value - top) / (deep - top)) * (bottom - 6);
  const step = niceStep((deep - top) / 4);
  c.font = "13px system-ui, sans-serif";
  c.textBaseline = "middle";
  c.textAlign = "right";
  c.strokeStyle = palette.grid;
  c.fillStyle = palette.soft;
  c.lineWidth = 1;
  c.beginPath();
  for (let k = Math.ceil(top / step); k * step <= deep; k += 1) {
    c.moveTo(left, y(k * step));
    c.lineTo(width, y(k * step));
    c.fillText(`${+(k * step).toPrecision(4)}`, left - 5, y(k * step));
  }
  for (const minute of width < 240 ? [0, 10] : [0, 5, 10]) {
    c.moveTo(x(now - 60 * minute), 0);
    c.lineTo(x(now - 60 * minute), bottom);
    c.textAlign = minute === 0 ? "right" : minute === 10 ? "left" : "center";
    c.fillText(minute ? `−${minute} min` : "now", x(now - 60 * minute), height - 7);
  }
  c.stroke();
  c.beginPath();
  for (const [time, value] of points) c.lineTo(x(time), y(value));
  c.strokeStyle = palette.sure;
  c.lineWidth = 3;
  c.lineJoin = "round";
  c.stroke();
  c.beginPath();
  bed.forEach(([time, value], k) => {
    if (value !== null) c[k && bed[k - 1][1] !== null ? "lineTo" : "moveTo"](x(time), y(value));
  });
  c.strokeStyle = palette.soft;
  c.lineWidth = 2;
  c.setLineDash([6, 4]);
  c.stroke();
  c.setLineDash([]);
}

// A band of one sd to either side of the value.
export function learntCurve(canvas, values) {
  const [c, w, h] = blank(canvas);
  const low = Math.min(...values.map(([v, sd]) => v - sd));
  const high = Math.max(...values.map(([v, sd]) => v + sd));
  const x = (k) => (k / Math.max(1, values.length - 1)) * w;
  const y = (v) => h - 2 - ((v - low) / Math.max(high - low, 1e-12)) * (h - 4);
  c.beginPath();
  values.forEach(([v, sd], k) => c.lineTo(x(k), y(v + sd)));
  [...values].reverse().forEach(([v, sd], k) => c.lineTo(x(values.length - 1 - k), y(v - sd)));
  c.globalAlpha = 0.3;
  c.fillStyle = palette.sure;
  c.fill();
  c.globalAlpha = 1;
  c.beginPath();
  values.forEach(([v], k) => c.lineTo(x(k), y(v)));
  c.strokeStyle = palette.sure;
  c.lineWidth = 2;
  c.stroke();
}
