// A map of metres north and east: charts, grid, track, marks, and the vehicle with its ellipse.

import { Track } from "./track.js";

const ELLIPSE = Math.sqrt(-2 * Math.log(0.05)); // 95 % of a normal distribution in the plane
const [LEAST_SCALE, MOST_SCALE] = [0.005, 2000]; // [pixels per metre]
const TAP = 8; // pixels that a finger may move

export class LiveMap {
  constructor(canvas, onTap, onMoved) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d");
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
    const places = [...(this.state?.marks ?? []).map((m) => [m.north, m.east])];
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
    const ratio = window.devicePixelRatio || 1;
    [this.width, this.height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const size = [Math.round(this.width * ratio), Math.round(this.height * ratio)];
    if (this.canvas.width !== size[0] || this.canvas.height !== size[1]) [this.canvas.width, this.canvas.height] = size;
    [this.cos, this.sin] = [Math.cos(this.turn), Math.sin(this.turn)];
    const c = this.context;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, this.width, this.height);
    for (const chart of this.charts) this.drawChart(chart);
    this.drawGrid();
    c.lineWidth = 3;
    c.lineJoin = "round";
    this.track.draw(c, (n, e) => this.toScreen(n, e));
    for (const mark of this.state?.marks ?? []) this.drawMark(mark);
    if (this.state) this.drawVehicle(this.state);
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
    c.strokeStyle = "#555";
    c.lineWidth = 1.5;
    if (shape.form === "area") { c.closePath(); c.fillStyle = "rgba(120, 110, 80, .25)"; c.fill(); }
    if (shape.form === "point") c.arc(...this.toScreen(...shape.points[0]), 4, 0, 7);
    c.stroke();
    if (shape.name) this.drawText(shape.name, ...this.toScreen(...shape.points[0]), "#333");
  }

  drawGrid() {
    const c = this.context;
    const wanted = 90 / this.scale;
    const power = 10 ** Math.floor(Math.log10(wanted));
    const step = [1, 2, 5, 10].map((k) => k * power).find((k) => k >= wanted);
    const reach = Math.hypot(this.width, this.height) / 2 / this.scale;
    c.strokeStyle = "#b9c2cc";
    c.lineWidth = 1;
    c.beginPath();
    for (const axis of [0, 1]) {
      for (let k = Math.ceil((this.centre[axis] - reach) / step); k * step < this.centre[axis] + reach; k += 1) {
        const ends = [-reach, reach].map((r) => (axis ? [this.centre[0] + r, k * step] : [k * step, this.centre[1] + r]));
        c.moveTo(...this.toScreen(...ends[0]));
        c.lineTo(...this.toScreen(...ends[1]));
      }
    }
    c.stroke();
    const [x, y] = [this.width - 20 - step * this.scale, this.height - (this.width < 800 ? 134 : 76)];
    c.strokeStyle = "#000";
    c.lineWidth = 3;
    c.beginPath();
    c.moveTo(x, y);
    c.lineTo(x + step * this.scale, y);
    c.stroke();
    this.drawText(`${+step.toPrecision(2)} m`, x - 6, y - 6, "#000");
  }

  drawMark(mark) {
    const c = this.context;
    const [x, y] = this.toScreen(mark.north, mark.east);
    if (mark.number === this.selected && this.state) {
      c.setLineDash([8, 6]);
      c.strokeStyle = "#000";
      c.lineWidth = 2;
      c.beginPath();
      c.moveTo(...this.toScreen(this.state.north, this.state.east));
      c.lineTo(x, y);
      c.stroke();
      c.setLineDash([]);
    }
    c.fillStyle = mark.kind === "mark" ? "#fff" : "#ffd400";
    c.strokeStyle = "#000";
    c.lineWidth = 2.5;
    c.beginPath();
    if (mark.kind === "mark") c.arc(x, y, 7, 0, 7);
    else c.rect(x - 6, y - 6, 12, 12);
    c.fill();
    c.stroke();
    this.drawText(mark.name || `${mark.number}`, x + 6, y - 6, "#000");
  }

  drawText(text, x, y, colour) {
    const c = this.context;
    c.font = "600 14px system-ui, sans-serif";
    c.lineWidth = 4;
    c.strokeStyle = "#fff";
    c.strokeText(text, x + 4, y - 2);
    c.fillStyle = colour;
    c.fillText(text, x + 4, y - 2);
  }

  drawVehicle(s) {
    const c = this.context;
    const [x, y] = this.toScreen(s.north, s.east);
    const [a, b, cross] = [s.north_sd ** 2, s.east_sd ** 2, s.cov_north_east];
    const [mean, part] = [(a + b) / 2, Math.hypot((a - b) / 2, cross)];
    const axes = [mean + part, mean - part].map((v) => ELLIPSE * Math.sqrt(Math.max(v, 0)) * this.scale);
    const bearing = 0.5 * Math.atan2(2 * cross, a - b); // of the longer axis, clockwise from north
    if (axes.every(Number.isFinite) && axes[0] < 1e6) {
      c.beginPath();
      c.ellipse(x, y, axes[0], axes[1], bearing - this.turn - Math.PI / 2, 0, 2 * Math.PI);
      c.fillStyle = "rgba(11, 61, 145, .15)";
      c.fill();
      c.strokeStyle = "#0b3d91";
      c.lineWidth = 2;
      c.stroke();
    }
    c.save();
    c.translate(x, y);
    c.rotate(s.yaw - this.turn);
    c.beginPath();
    for (const [px, py] of [[0, -18], [10, 12], [0, 6], [-10, 12]]) c.lineTo(px, py);
    c.closePath();
    c.fillStyle = "#000";
    c.fill();
    c.strokeStyle = "#fff";
    c.lineWidth = 2;
    c.stroke();
    c.restore();
  }

  drawNorth() {
    const c = this.context;
    c.save();
    c.translate(this.width - 30, 92);
    c.rotate(-this.turn);
    c.beginPath();
    for (const [px, py] of [[0, -22], [8, 8], [0, 3], [-8, 8]]) c.lineTo(px, py);
    c.closePath();
    c.fillStyle = "#b00020";
    c.fill();
    c.restore();
    this.drawText("N", this.width - 39, 120, "#000");
  }
}
