// The track in growing typed arrays, and its colours by uncertainty.

export const COLOURS = ["#0b3d91", "#0a6fb5", "#00857a", "#3f8f2f", "#a37c00", "#c45a00", "#c21f1f", "#7a0050"];
const LEAST = 0.1; // sd of the first colour's end [m]; each next one ends at twice that

export const colourOf = (sd) => Math.max(0, Math.min(COLOURS.length - 1, Math.ceil(Math.log2(sd / LEAST))));
export const colourEnd = (k) => LEAST * 2 ** k;

export class Track {
  constructor() { this.clear(); }

  clear() {
    this.length = 0;
    this.north = new Float64Array(4096);
    this.east = new Float64Array(4096);
    this.colour = new Uint8Array(4096);
  }

  add(points) {
    for (const [, north, east, , sd] of points) {
      if (this.length === this.north.length) this.grow();
      this.north[this.length] = north;
      this.east[this.length] = east;
      this.colour[this.length] = colourOf(sd);
      this.length += 1;
    }
  }

  grow() {
    for (const name of ["north", "east", "colour"]) {
      const larger = new this[name].constructor(2 * this[name].length);
      larger.set(this[name]);
      this[name] = larger;
    }
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
        context.strokeStyle = COLOURS[colour];
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
