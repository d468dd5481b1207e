// A map of metres north and east: charts, grid, track, marks, and the vehicle with its ellipse.

import { niceStep } from "./dials.js";
import { blank, palette } from "./look.js";
import { Track } from "./track.js";

const ELLIPSE = Math.sqrt(-2 * Math.log(0.05)); // 95 % of a normal distribution in the plane
const [LEAST_SCALE, MOST_SCALE] = [0.005, 2000]; // [pixels per metre]
const TAP = 8; // pixels that a finger may move

// Half axes of a state's 95 % ellipse [m], NaN where unknown, and the bearing of the longer one [rad].
export function ellipse(s) {
  const [a, b, cross] = [s.north_sd, s.east_sd].every((sd) => sd !== null) ? [s.north_sd ** 2, s.east_sd ** 2, s.cov_north_east] : [NaN, NaN, NaN];
  const [mean, part] = [(a + b) / 2, Math.hypot((a - b) / 2, cross)];
  const [longer, shorter] = [mean + part, mean - part].map((v) => ELLIPSE * Math.sqrt(Math.max(v, 0)));
  return { longer, shorter, angle: 0.5 * Math.atan2(2 * cross, a - b) };
}

// The part of a line that is on the screen; null where there is none (Liang and Barsky).
function clipped([x0, y0], [x1, y1], width, height) {
  let [from, to] = [0, 1];
  for (const [p, q] of [[x0 - x1, x0], [x1 - x0, width - x0], [y0 - y1, y0], [y1 - y0, height - y0]]) {
    if (p === 0 && q < 0) return null;
    if (p < 0) from = Math.max(from, q / p);
    if (p > 0) to = Math.min(to, q / p);
  }
  return from < to ? [from, to].map((t) => [x0 + t * (x1 - x0), y0 + t * (y1 - y0)]) : null;
}

export class LiveMap {
  constructor(canvas, onTap, onMoved) {
    this.canvas = canvas;
    this.track = new Track();
    this.centre = [0, 0];
    this.scale = 20;
    this.turn = 0; // what is up, clockwise from north [rad]
    this.follow = true;
    this.headingUp = false;
    this.state = null;
    this.charts = [];
    this.selected = null;
    this.slowest = 0; // longest frame [ms]
    this.onTap = onTap;
    this.onMoved = onMoved;
    this.pointers = new Map();
    new ResizeObserver(() => this.changed()).observe(canvas);
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel"]) {
      canvas.addEventListener(kind, (event) => this[kind](event));
    }
  }

  changed() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      const begin = performance.now();
      this.draw();
      this.slowest = Math.max(this.slowest, performance.now() - begin);
    });
  }

  show(state) {
    this.state = state;
    if (this.follow && state) this.centre = [state.north, state.east];
    this.turn = this.headingUp && state ? state.yaw : 0;
    this.changed();
  }

  toScreen(north, east) {
    const [n, e] = [north - this.centre[0], east - this.centre[1]];
    const [c, s] = [this.cos, this.sin];
    return [this.width / 2 + this.scale * (e * c - n * s), this.height / 2 - this.scale * (n * c + e * s)];
  }

  toPlace(x, y) {
    const [right, up] = [(x - this.width / 2) / this.scale, (this.height / 2 - y) / this.scale];
    const [c, s] = [Math.cos(this.turn), Math.sin(this.turn)];
    return [this.centre[0] + up * c - right * s, this.centre[1] + right * c + up * s];
  }

  zoom(factor, x = this.width / 2, y = this.height / 2) {
    const before = this.toPlace(x, y);
    this.scale = Math.max(LEAST_SCALE, Math.min(MOST_SCALE, this.scale * factor));
    if (!this.follow) {
      const after = this.toPlace(x, y);
      this.centre = [this.centre[0] + before[0] - after[0], this.centre[1] + before[1] - after[1]];
    }
    this.changed();
  }

  pan(x, y) {
    this.follow = false;
    this.centre = this.toPlace(this.width / 2 - x, this.height / 2 - y);
    this.onMoved();
    this.changed();
  }

  fit() {
    const around = [...(this.state?.marks ?? []), ...(this.state?.beacons ?? []), this.state?.ship].filter(Boolean);
    const places = around.map((m) => [m.north, m.east]);
    for (let k = 0; k < this.track.length; k += 1) places.push([this.track.north[k], this.track.east[k]]);
    if (!places.length) return;
    const low = [Infinity, Infinity];
    const high = [-Infinity, -Infinity];
    for (const place of places) {
      for (const k of [0, 1]) {
        low[k] = Math.min(low[k], place[k]);
        high[k] = Math.max(high[k], place[k]);
      }
    }
    this.follow = false;
    this.centre = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
    const size = Math.max(high[0] - low[0], high[1] - low[1], 2);
    this.scale = (0.65 * Math.min(this.width, this.height)) / size;
    this.onMoved();
    this.changed();
  }

  wheel(event) {
    event.preventDefault();
    this.zoom(Math.exp(-event.deltaY / 400), event.offsetX, event.offsetY);
  }

  pointerdown(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    this.moved = this.pointers.size > 1 ? Infinity : 0;
  }

  pointermove(event) {
    const before = this.pointers.get(event.pointerId);
    if (!before) return;
    const now = [event.offsetX, event.offsetY];
    const step = [now[0] - before[0], now[1] - before[1]];
    this.moved += Math.hypot(...step);
    if (this.pointers.size === 2) {
      const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
      const spread = (from) => Math.max(1, Math.hypot(from[0] - other[0], from[1] - other[1]));
      this.zoom(spread(now) / spread(before), other[0], other[1]);
    } else if (this.moved > TAP) {
      this.pan(...step);
    }
    this.pointers.set(event.pointerId, now);
  }

  pointerup(event) {
    const last = this.pointers.size === 1;
    this.pointers.delete(event.pointerId);
    if (last && this.moved <= TAP) this.onTap(this.toPlace(event.offsetX, event.offsetY));
  }

  pointercancel(event) { this.pointers.delete(event.pointerId); }

  draw() {
    [this.context, this.width, this.height] = blank(this.canvas);
    [this.cos, this.sin] = [Math.cos(this.turn), Math.sin(this.turn)];
    const c = this.context;
    for (const chart of this.charts) this.drawChart(chart);
    this.drawGrid();
    c.lineWidth = 3;
    c.lineJoin = "round";
    this.track.draw(c, (n, e) => this.toScreen(n, e));
    if (this.track.length) this.drawHome();
    for (const mark of this.state?.marks ?? []) this.drawMark(mark);
    for (const crossing of this.state?.crossings ?? []) this.drawCrossing(crossing);
    for (const range of this.state?.ranges ?? []) this.drawRange(range);
    for (const beacon of this.state?.beacons ?? []) this.drawBeacon(beacon);
    if (this.state?.ship) this.drawShip(this.state.ship);
    if (this.state) this.drawVehicle(this.state);
    this.drawNumbers();
    this.drawNorth();
  }

  drawChart(chart) {
    for (const image of chart.images ?? []) this.drawImage(image.element, image.corners);
    for (const shape of chart.shapes ?? []) this.drawShape(shape);
  }

  // An image by the places of its top left, top right and bottom left corner.
  drawImage(image, corners) {
    if (!image.complete || !image.naturalWidth) return;
    const c = this.context;
    const [o, x, y] = corners.map(([n, e]) => this.toScreen(n, e));
    const [w, h] = [image.naturalWidth, image.naturalHeight];
    c.save();
    c.transform((x[0] - o[0]) / w, (x[1] - o[1]) / w, (y[0] - o[0]) / h, (y[1] - o[1]) / h, o[0], o[1]);
    c.drawImage(image, 0, 0);
    c.restore();
  }

  drawShape(shape) {
    const c = this.context;
    c.beginPath();
    shape.points.forEach(([n, e], k) => c[k ? "lineTo" : "moveTo"](...this.toScreen(n, e)));
    c.strokeStyle = palette.soft;
    c.lineWidth = 1.5;
    if (shape.form === "area") { c.closePath(); c.fillStyle = "rgba(120, 110, 80, .25)"; c.fill(); }
    if (shape.form === "point") c.arc(...this.toScreen(...shape.points[0]), 4, 0, 7);
    c.stroke();
    if (shape.name) this.drawText(shape.name, ...this.toScreen(...shape.points[0]), palette.soft);
  }

  // Lines of the grid: axis (0 = of one north), where on it, and their ends on the edges of the screen.
  gridLines() {
    const step = niceStep((this.width < 600 ? 60 : 90) / this.scale);
    const reach = Math.hypot(this.width, this.height) / 2 / this.scale;
    const lines = [];
    for (const axis of [0, 1]) {
      for (let k = Math.ceil((this.centre[axis] - reach) / step); k * step < this.centre[axis] + reach; k += 1) {
        const ends = [-reach, reach].map((r) => (axis ? [this.centre[0] + r, k * step] : [k * step, this.centre[1] + r]));
        const seen = clipped(...ends.map((end) => this.toScreen(...end)), this.width, this.height);
        if (seen) lines.push([axis, k * step, seen]);
      }
    }
    return [step, lines];
  }

  drawGrid() {
    const c = this.context;
    c.strokeStyle = palette.grid;
    c.lineWidth = 1;
    c.beginPath();
    for (const [, , [from, to]] of this.gridLines()[1]) {
      c.moveTo(...from);
      c.lineTo(...to);
    }
    c.stroke();
  }

  // What a line's place is, where it meets the left or the lower edge; and the length of a step.
  drawNumbers() {
    const c = this.context;
    const [step, lines] = this.gridLines();
    for (const [axis, value, ends] of lines) {
      const left = ends.find((end) => end[0] < 1);
      const end = left ?? ends.find((one) => one[1] > this.height - 1);
      if (!end || (left ? end[1] < 16 || end[1] > this.height - 36 : end[0] < 44 || end[0] > this.width - 56)) continue;
      const text = `${+Math.abs(value).toPrecision(6)} ${(axis ? "WE" : "SN")[+(value >= 0)]}`;
      this.drawText(text, end[0], end[1] - (left ? 0 : 4), palette.soft);
    }
    const [x, y] = [this.width - 12 - step * this.scale, this.height - 34];
    c.strokeStyle = palette.ink;
    c.lineWidth = 3;
    c.beginPath();
    for (const [px, py] of [[0, -6], [0, 0], [step * this.scale, 0], [step * this.scale, -6]]) c.lineTo(x + px, y + py);
    c.stroke();
    this.drawText(`${+step.toPrecision(2)} m`, x, y - 6, palette.ink);
  }

  drawHome() {
    const c = this.context;
    const [x, y] = this.toScreen(this.track.north[0], this.track.east[0]);
    c.beginPath();
    for (const [px, py] of [[0, -11], [10, -2], [7, -2], [7, 8], [-7, 8], [-7, -2], [-10, -2]]) c.lineTo(x + px, y + py);
    c.closePath();
    c.fillStyle = palette.sure;
    c.fill();
    c.strokeStyle = palette.paper;
    c.lineWidth = 2;
    c.stroke();
  }

  drawMark(mark) {
    const c = this.context;
    const [x, y] = this.toScreen(mark.north, mark.east);
    if (mark.number === this.selected && this.state) {
      c.setLineDash([8, 6]);
      c.strokeStyle = palette.ink;
      c.lineWidth = 2;
      c.beginPath();
      c.moveTo(...this.toScreen(this.state.north, this.state.east));
      c.lineTo(x, y);
      c.stroke();
      c.setLineDash([]);
    }
    c.fillStyle = mark.kind === "mark" ? palette.paper : palette.mark;
    c.strokeStyle = palette.ink;
    c.lineWidth = 2.5;
    c.beginPath();
    if (mark.kind === "mark") c.arc(x, y, 7, 0, 7);
    else c.rect(x - 6, y - 6, 12, 12);
    c.fill();
    c.stroke();
    this.drawText(mark.name || `${mark.number}`, x + 6, y - 6, palette.ink);
  }

  drawText(text, x, y, colour) {
    const c = this.context;
    c.font = "600 14px system-ui, sans-serif";
    c.lineWidth = 4;
    c.strokeStyle = palette.sea;
    c.strokeText(text, x + 4, y - 2);
    c.fillStyle = colour;
    c.fillText(text, x + 4, y - 2);
  }

  drawEllipse(s) {
    const c = this.context;
    const [x, y] = this.toScreen(s.north, s.east);
    const { longer, shorter, angle } = ellipse(s);
    if (!(longer * this.scale < 1e6)) return;
    c.beginPath();
    c.ellipse(x, y, longer * this.scale, shorter * this.scale, angle - this.turn - Math.PI / 2, 0, 2 * Math.PI);
    c.globalAlpha = 0.18;
    c.fillStyle = palette.sure;
    c.fill();
    c.globalAlpha = 1;
    c.strokeStyle = palette.sure;
    c.lineWidth = 2;
    c.stroke();
  }

  // Where an acoustic range puts the vehicle.
  drawRange(range) {
    const c = this.context;
    c.beginPath();
    c.arc(...this.toScreen(range.north, range.east), range.radius * this.scale, 0, 2 * Math.PI);
    c.setLineDash([3, 5]);
    c.strokeStyle = palette.soft;
    c.lineWidth = 1.5;
    c.stroke();
    c.setLineDash([]);
  }

  // Where soundings of two lines, or of a line and a chart, agree: a ring; a cross where they were not matched.
  drawCrossing(crossing) {
    const c = this.context;
    const [x, y] = this.toScreen(crossing.north, crossing.east);
    c.beginPath();
    if (crossing.matched) c.arc(x, y, 5, 0, 2 * Math.PI);
    else for (const side of [-4, 4]) {
      c.moveTo(x - 4, y - side);
      c.lineTo(x + 4, y + side);
    }
    c.strokeStyle = crossing.matched ? palette.ink : palette.soft;
    c.lineWidth = 1.5;
    c.stroke();
  }

  drawBeacon(beacon) {
    this.drawEllipse(beacon);
    const [x, y] = this.toScreen(beacon.north, beacon.east);
    this.drawSign([[0, -8], [8, 0], [0, 8], [-8, 0]], x, y, 0, palette.paper, palette.ink);
    const behind = beacon.behind === null ? "" : beacon.behind > 0 ? `? +${beacon.behind.toFixed(1)}` : "?";
    this.drawText(beacon.name + behind, x + 6, y - 6, palette.ink);
  }

  // A hull that points where the ship heads; a square where that is not known.
  drawShip(ship) {
    const [x, y] = this.toScreen(ship.north, ship.east);
    const hull = [[0, -20], [8, -8], [8, 18], [-8, 18], [-8, -8]];
    const known = ship.heading !== null;
    this.drawSign(known ? hull : [[-8, -8], [8, -8], [8, 8], [-8, 8]], x, y, known ? ship.heading - this.turn : 0, palette.soft, palette.paper);
  }

  drawSign(corners, x, y, angle, fill, edge) {
    const c = this.context;
    c.save();
    c.translate(x, y);
    c.rotate(angle);
    c.beginPath();
    for (const [px, py] of corners) c.lineTo(px, py);
    c.closePath();
    c.fillStyle = fill;
    c.fill();
    c.strokeStyle = edge;
    c.lineWidth = 2;
    c.stroke();
    c.restore();
  }

  drawVehicle(s) {
    const [x, y] = this.toScreen(s.north, s.east);
    this.drawEllipse(s);
    this.drawSign([[0, -18], [10, 12], [0, 6], [-10, 12]], x, y, s.yaw - this.turn, palette.ink, palette.paper);
  }

  drawNorth() {
    const c = this.context;
    c.save();
    c.translate(this.width - 26, 30);
    c.rotate(-this.turn);
    c.beginPath();
    for (const [px, py] of [[0, -22], [8, 8], [0, 3], [-8, 8]]) c.lineTo(px, py);
    c.closePath();
    c.fillStyle = palette.bad;
    c.fill();
    c.restore();
    this.drawText("N", this.width - 35, 58, palette.ink);
  }
}
