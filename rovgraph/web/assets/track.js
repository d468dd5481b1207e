// The track in growing typed arrays, and its colours by uncertainty.

import { palette } from "./look.js";

const LEAST = 0.1; // sd of the first colour's end [m]; each next one ends at twice that
const ARRAYS = ["time", "north", "east", "down"];

export const colourOf = (sd) => Math.max(0, Math.min(palette.sd.length - 1, Math.ceil(Math.log2(sd / LEAST))));
export const colourEnd = (k) => LEAST * 2 ** k;

export class Track {
  constructor() { this.clear(); }

  clear() {
    this.length = 0;
    for (const name of ARRAYS) this[name] = new Float64Array(4096);
    this.colour = new Uint8Array(4096);
  }

  add(points) {
    for (const point of points) {
      if (this.length === this.north.length) this.grow();
      ARRAYS.forEach((name, k) => { this[name][this.length] = point[k]; });
      this.colour[this.length] = colourOf(point[4]);
      this.length += 1;
    }
  }

  grow() {
    for (const name of [...ARRAYS, "colour"]) {
      const larger = new this[name].constructor(2 * this[name].length);
      larger.set(this[name]);
      this[name] = larger;
    }
  }

  // Time and depth of the points from a time on.
  since(time) {
    let k = this.length;
    while (k > 0 && this.time[k - 1] >= time) k -= 1;
    return Array.from({ length: this.length - k }, (_, n) => [this.time[k + n], this.down[k + n]]);
  }

  // Strokes of one colour each; what is nearer than a pixel and a half is passed over.
  draw(context, toScreen) {
    let [x, y] = [NaN, NaN];
    let colour = -1;
    for (let k = 0; k < this.length; k += 1) {
      const [nextX, nextY] = toScreen(this.north[k], this.east[k]);
      if (Math.abs(nextX - x) + Math.abs(nextY - y) < 1.5 && this.colour[k] === colour) continue;
      if (this.colour[k] !== colour) {
        if (colour >= 0) { context.lineTo(nextX, nextY); context.stroke(); }
        colour = this.colour[k];
        context.strokeStyle = palette.sd[colour];
        context.beginPath();
        context.moveTo(nextX, nextY);
      } else {
        context.lineTo(nextX, nextY);
      }
      [x, y] = [nextX, nextY];
    }
    if (colour >= 0) context.stroke();
  }
}
