// Numbers beside the map. Text reaches the page as text only.

const DEG = 180 / Math.PI;
const HISTORY = 240; // values of a small curve

export function element(name, text = "", className = "") {
  const made = document.createElement(name);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

export const metres = (v) => (v === null || v === undefined ? "–" : v.toFixed(Math.abs(v) < 10 ? 2 : Math.abs(v) < 1000 ? 1 : 0));
const spread = (v) => (v === null ? "–" : v < 100 ? `${+v.toPrecision(2)}` : v.toFixed(0));
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

export class Gauges {
  constructor() {
    this.gauges = new Map();
    this.rows = new Map();
    this.curves = new Map();
    this.units = {}; // calibration variable -> factor to what is shown, and its unit
  }

  show(s) {
    const kinds = new Set(s.limits.map((one) => one.kind));
    const heading = ((s.yaw * DEG) % 360 + 360) % 360;
    this.gauge("heading", `${heading.toFixed(1)}°`, `heading, sd ${s.yaw_sd === null ? "–" : spread(s.yaw_sd * DEG)}°`, kinds.has("heading"));
    this.gauge("depth", `${metres(s.down)} m`, `depth, sd ${spread(s.down_sd)} m`);
    this.gauge("altitude", s.altitude === null ? "–" : `${metres(s.altitude)} m`, "altitude");
    this.gauge("speed", `${s.speed === null ? "–" : s.speed.toFixed(2)} m/s`, "speed");
    this.gauge("sd", `${metres(s.ellipse_sd)} m`, "position sd", kinds.has("position"));
    const lost = s.lock_lost_s > 0;
    const lock = s.lock_lost_s === null ? "–" : lost ? duration(s.lock_lost_s) : "locked";
    this.gauge("lock", lock, lost ? "since bottom lock" : "bottom lock", lost);
    this.gauge("north", `${metres(s.north)} m`, `north, sd ${spread(s.north_sd)} m`);
    this.gauge("east", `${metres(s.east)} m`, `east, sd ${spread(s.east_sd)} m`);
    this.gauge("distance", `${metres(s.distance)} m`, "travelled");
    this.gauge("verdict", s.verdict, "verdict", s.verdict === "wrong");
    this.gauge("clock", clock(s.time), "time");
    this.sensors(s.sensors);
    this.learnt(s.calibration, s.time);
  }

  gauge(name, value, label, bad = false) {
    let found = this.gauges.get(name);
    if (!found) {
      found = element("div", "", "gauge");
      found.append(element("b"), element("span"));
      document.getElementById("gauges").append(found);
      this.gauges.set(name, found);
    }
    set(found.children[0], value);
    set(found.children[1], label);
    found.classList.toggle("bad", bad);
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
      curve(found.canvas, found.values);
    }
  }
}

function set(node, text) {
  if (node.textContent !== text) node.textContent = text;
}

// A band of one sd to either side of the value.
function curve(canvas, values) {
  const [w, h] = [130, 36];
  const ratio = window.devicePixelRatio || 1;
  [canvas.width, canvas.height] = [w * ratio, h * ratio];
  const c = canvas.getContext("2d");
  c.scale(ratio, ratio);
  const low = Math.min(...values.map(([v, sd]) => v - sd));
  const high = Math.max(...values.map(([v, sd]) => v + sd));
  const x = (k) => (k / Math.max(1, values.length - 1)) * w;
  const y = (v) => h - 2 - ((v - low) / Math.max(high - low, 1e-12)) * (h - 4);
  c.beginPath();
  values.forEach(([v, sd], k) => c.lineTo(x(k), y(v + sd)));
  [...values].reverse().forEach(([v, sd], k) => c.lineTo(x(values.length - 1 - k), y(v - sd)));
  c.fillStyle = "#c3d2ea";
  c.fill();
  c.beginPath();
  values.forEach(([v], k) => c.lineTo(x(k), y(v)));
  c.strokeStyle = "#0b3d91";
  c.lineWidth = 2;
  c.stroke();
}
