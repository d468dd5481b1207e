// Dark or daylight, and what is drawn in its colours. The colours themselves stand in page.css.

import { keep, recall } from "./keep.js";

const NAMES = ["ink", "soft", "paper", "line", "sea", "grid", "sure", "bad", "mark"];
const SD_COLOURS = 8; // --sd-0 to --sd-7, of the track
const root = document.documentElement;
const system = matchMedia("(prefers-color-scheme: dark)");

export const palette = { sd: [] };

export class Look {
  // As it was chosen here, or else as the system has it.
  constructor(onChange) {
    this.onChange = onChange;
    this.chosen = recall("look");
    system.addEventListener("change", () => this.apply());
    this.apply();
  }

  get dark() { return (this.chosen ?? (system.matches ? "dark" : "daylight")) === "dark"; }

  toggle() {
    this.chosen = this.dark ? "daylight" : "dark";
    keep("look", this.chosen);
    this.apply();
  }

  apply() {
    root.dataset.look = this.dark ? "dark" : "daylight";
    const style = getComputedStyle(root);
    const colour = (name) => style.getPropertyValue(`--${name}`).trim();
    for (const name of NAMES) palette[name] = colour(name);
    palette.sd = Array.from({ length: SD_COLOURS }, (_, k) => colour(`sd-${k}`));
    this.onChange(this.dark);
  }
}

// An empty canvas in pixels of the page: its context, width and height.
export function blank(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const [width, height] = [canvas.clientWidth, canvas.clientHeight];
  const size = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return [context, width, height];
}
