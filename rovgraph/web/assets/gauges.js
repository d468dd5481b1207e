// Numbers beside the map. Text reaches the page as text only.

import { Bottom, currentCurve, depthCurve, learntCurve, rose } from "./dials.js";

const DEG = 180 / Math.PI;
const KNOT = 1852 / 3600; // [m/s]
const AT_HOME_M = 1; // nearer than that its bearing says nothing
const HISTORY = 240; // values of a small curve

export function element(name, text = "", className = "") {
  const made = document.createElement(name);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

export const metres = (v) => (v === null || v === undefined ? "–" : v.toFixed(Math.abs(v) < 10 ? 2 : Math.abs(v) < 1000 ? 1 : 0).replace("-", "−"));
const spread = (v) => (v === null ? "–" : v < 100 ? `${+(+v.toPrecision(2)).toFixed(3)}` : v.toFixed(0));
export const bearing = (radians) => `${(Math.round(radians * DEG + 360) % 360).toString().padStart(3, "0")}°`;

export function duration(s) {
  if (s === null || s === undefined) return "–";
  if (s < 10) return `${s.toFixed(1)} s`;
  return s < 120 ? `${s.toFixed(0)} s` : s < 7200 ? `${(s / 60).toFixed(0)} min` : `${(s / 3600).toFixed(1)} h`;
}

export function clock(time) {
  if (time === null) return "–";
  return time > 1e9 ? `${new Date(1000 * time).toISOString().slice(11, 19)} UTC` : `${time.toFixed(1)} s`;
}

export function elapsed(s) {
  const [whole, two] = [Math.max(0, Math.floor(s)), (n) => `${n}`.padStart(2, "0")];
  return `${Math.floor(whole / 3600)}:${two(Math.floor(whole / 60) % 60)}:${two(whole % 60)}`;
}

const VERDICTS = {
  trusted: ["good", "sensors agree"],
  doubtful: ["warn", "may be wrong"],
  wrong: ["bad", "do not use it"],
};

export class Gauges {
  constructor() {
    this.gauges = new Map();
    this.rows = new Map();
    this.curves = new Map();
    this.bottom = new Bottom();
    this.units = {}; // calibration variable -> factor to what is shown, and its unit
    this.resumed = false; // the track begins where a run before it ended
  }

  show(s, track) {
    const kinds = new Set(s.limits.map((one) => one.kind));
    const [look, meaning] = VERDICTS[s.verdict];
    this.gauge("status", "verdict", s.verdict, meaning, look);
    this.gauge("status", "sd", `${metres(s.ellipse_sd)} m`, "position sd", kinds.has("position") ? "bad" : "good");
    this.lock(s);
    const begin = track.length ? track.time[0] : s.time;
    this.gauge("times", "since", elapsed(s.time - begin), this.resumed ? "since it resumed" : "dive time");

    const turn = ((s.yaw * DEG) % 360 + 360) % 360;
    const degrees = turn.toFixed(1).padStart(5, "0");
    const heading = this.gauge("gauges", "heading", `${degrees}°`, `heading, sd ${s.yaw_sd === null ? "–" : spread(s.yaw_sd * DEG)}°`, kinds.has("heading") ? "bad" : "", true);
    const [n, e] = track.length ? [track.north[0] - s.north, track.east[0] - s.east] : [0, 0];
    const [far, home] = [Math.hypot(n, e), Math.atan2(e, n)];
    const away = far >= AT_HOME_M;
    rose(heading.lastChild, s.yaw, s.yaw_sd, away ? home : null);
    this.gauge("gauges", "home", `${metres(far)} m\n${away ? bearing(home) : "–"}`, this.resumed ? "to where it resumed" : "home, to the start");
    this.gauge("gauges", "speed", `${s.speed === null ? "–" : s.speed.toFixed(2)} m/s`, `speed, ${s.speed === null ? "–" : (s.speed / KNOT).toFixed(1)} kn`);
    if (s.altitude !== null || this.gauges.has("altitude")) this.gauge("gauges", "altitude", s.altitude === null ? "–" : `${metres(s.altitude)} m`, s.altitude_sd == null ? "altitude" : `altitude, sd ${spread(s.altitude_sd)} m`);
    if (s.bottom_depth != null || this.gauges.has("bottom")) this.gauge("gauges", "bottom", `${metres(s.bottom_depth)} m`, s.bottom_depth == null ? "depth of the bottom" : `depth of the bottom, sd ${spread(s.bottom_depth_sd)} m`);
    this.bottom.add(s.time, s.down, s.altitude);
    const bed = this.bottom.points;
    const dashed = bed.some((point) => point[1] !== null) ? "; dashed: bottom" : "";
    const depth = this.gauge("gauges", "depth", `${metres(s.down)} m`, `depth, sd ${spread(s.down_sd)} m${dashed}`, "", true);
    depthCurve(depth.lastChild, track, s.time, s.down, bed);
    this.gauge("gauges", "north", `${metres(s.north)} m`, `north, sd ${spread(s.north_sd)} m`);
    this.gauge("gauges", "east", `${metres(s.east)} m`, `east, sd ${spread(s.east_sd)} m`);
    this.current(s.current ?? [], s.down);
    this.gauge("gauges", "distance", `${metres(s.distance)} m`, "travelled");
    this.gauge("gauges", "clock", clock(s.time), "time of the estimate");
    this.sensors(s.sensors);
    this.learnt(s.calibration, s.time);
  }

  // By profiles of the water: at the vehicle's depth, and as a function of depth.
  current(layers, depth) {
    if (!layers.length) return;
    const at = layers.reduce((best, layer) => (Math.abs(layer.depth - depth) < Math.abs(best.depth - depth) ? layer : best));
    const to = (Math.atan2(at.east, at.north) * 180 / Math.PI + 360) % 360;
    const label = `current at ${at.depth} m, to ${to.toFixed(0)}°, sd ${spread(Math.hypot(at.north_sd, at.east_sd))} m/s; north solid, east dashed`;
    const found = this.gauge("gauges", "current", `${Math.hypot(at.north, at.east).toFixed(2)} m/s`, label, "", true);
    currentCurve(found.lastChild, layers, depth);
  }

  lock(s) {
    const state = s.sensors.dvl?.state;
    const beams = Object.entries(s.sensors).filter(([name]) => /^dvl_beam_[0-9]$/.test(name)).map(([, beam]) => beam.state);
    const good = beams.filter((beam) => beam === "ok").length;
    if (good) this.gauge("status", "lock", `${good} of ${beams.length}`, "beams of the DVL used", good > 2 ? "good" : "warn");
    else if (state === undefined) this.gauge("status", "lock", "–", "no DVL");
    else if (state === "ok") this.gauge("status", "lock", "locked", "bottom lock", "good");
    else if (state === "rejected") this.gauge("status", "lock", "rejected", "DVL contradicts the estimate", "warn");
    else this.gauge("status", "lock", state, `DVL, for ${duration(s.lock_lost_s)}`, "bad");
  }

  gauge(place, name, value, label, look = "", drawn = false) {
    let found = this.gauges.get(name);
    if (!found) {
      found = element("div");
      found.append(element("b"), element("span"));
      if (drawn) found.append(element("canvas"));
      document.getElementById(place).append(found);
      this.gauges.set(name, found);
    }
    set(found.children[0], value);
    set(found.children[1], label);
    found.className = `gauge ${name} ${look}`;
    return found;
  }

  sensors(all) {
    const body = document.querySelector("#sensors tbody");
    for (const [name, h] of Object.entries(all)) {
      let rows = this.rows.get(name);
      if (!rows) {
        rows = [element("tr"), element("tr")];
        for (let k = 0; k < 5; k += 1) rows[0].append(element("td"));
        const reason = element("td", "", "reason");
        reason.colSpan = 5;
        rows[1].append(reason);
        body.append(...rows);
        this.rows.set(name, rows);
      }
      const cells = rows[0].children;
      const state = h.failed_s > 0 ? `${h.state} ${duration(h.failed_s)}` : h.state;
      [name, state, duration(h.age), ...(h.used + h.rejected ? [`${h.used}`, `${h.rejected}`] : ["–", "–"])].forEach((text, k) => set(cells[k], text));
      cells[1].className = h.state === "ok" ? "ok" : h.state === "silent" || h.state === "frozen" ? "failed" : "doubtful";
      set(rows[1].children[0], h.reason);
      rows[1].hidden = !h.reason;
    }
  }

  // Each estimated variable with its sd, and a small curve of how it was learnt.
  learnt(calibration, time) {
    for (const [name, [value, sd]] of Object.entries(calibration)) {
      if (value === null || sd === null) continue;
      let found = this.curves.get(name);
      if (!found) {
        found = { row: element("div"), text: element("span"), canvas: element("canvas"), values: [], every: 1, next: -Infinity };
        found.canvas.setAttribute("aria-hidden", "true");
        found.row.append(found.text, found.canvas);
        document.getElementById("learnt").append(found.row);
        this.curves.set(name, found);
      }
      const [k, unit] = this.units[name] ?? [1, ""];
      set(found.text, `${name} ${(k * value).toPrecision(4)} ± ${(k * sd).toPrecision(2)}${unit && ` ${unit}`}`);
      if (time < found.next) continue;
      found.next = time + found.every;
      found.values.push([value, sd]);
      if (found.values.length > HISTORY) {
        found.values = found.values.filter((_, n) => n % 2);
        found.every *= 2;
      }
      learntCurve(found.canvas, found.values);
    }
  }
}

function set(node, text) {
  if (node.textContent !== text) node.textContent = text;
}
