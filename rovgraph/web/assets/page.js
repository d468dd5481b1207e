// The live page: what comes over the link goes to map, gauges and lists; what a person wants goes back.

import { bearing, clock, duration, element, Gauges, metres } from "./gauges.js";
import { Link } from "./link.js";
import { Look, palette } from "./look.js";
import { ellipse, LiveMap } from "./map.js";
import { Siren } from "./siren.js";
import { colourEnd } from "./track.js";

const SHOWN_EVENTS = 200;
const SHOWN_ALARMS = 4;
const STALE_S = 2; // without a solution
const GATE = 6; // of fixes, fix.gate_sd as it is by default
const widget = location.hash.includes("widget"); // the map alone, as in Cockpit
const at = (id) => document.getElementById(id);

const gauges = new Gauges();
const map = new LiveMap(at("map"), tapped, showButtons);
const siren = new Siren(at("sound"));
let state = null;
let chartsPlaced = false;

const look = new Look((dark) => {
  at("look").textContent = dark ? "Day" : "Dark";
  if (state) showNumbers();
  map.changed();
});
at("look").addEventListener("click", () => look.toggle());

const link = new Link({
  message(news) {
    at("login").hidden = true;
    document.body.classList.toggle("widget", widget);
    if (news.type === "begin") {
      map.track.clear();
      gauges.units = news.units;
      gauges.resumed = false;
      at("events").replaceChildren();
      addEvents(news.events);
    } else if (news.type === "track") {
      map.track.add(news.points);
    } else {
      map.track.add(news.points);
      addEvents(news.events);
      showState(news);
    }
    map.changed();
  },
  lost() {
    connection("no connection to rovgraph: what you see is old", true);
    if (state) siren.tell([["connection", "wrong"]]);
  },
  refused() {
    connection("locked", true);
    document.body.classList.remove("widget");
    at("login").hidden = false;
  },
});

function connection(text, bad) {
  if (at("connection").textContent !== text) at("connection").textContent = text;
  at("connection").className = bad ? "bad" : "good";
  document.body.classList.toggle("old", bad);
}

function showState(news) {
  if (news.time === null) {
    connection("connected; rovgraph waits for its first position", false);
    return;
  }
  news.marks ??= state?.marks ?? []; // told only when they change
  state = news;
  const old = news.age_s > STALE_S;
  connection(old ? `no solution for ${duration(news.age_s)}` : "live", old);
  map.show(news);
  showNumbers();
  showAlarms(news, old);
  showMarks(news.marks);
  if (!chartsPlaced && news.latitude !== null) {
    chartsPlaced = true;
    loadCharts();
  }
}

function showNumbers() {
  gauges.show(state, map.track);
  const { longer, shorter } = ellipse(state);
  const signs = [[state.ship, "grey hull: the ship"], [state.beacons?.length, "diamond: beacon"], [state.ranges?.length, "dotted circle: newest range"], [state.crossings?.length, "ring: lines match (cross: not)"]];
  at("signs-legend").textContent = signs.filter(([known]) => known).map(([, text]) => text).join(" · ");
  at("signs-legend").hidden = !at("signs-legend").textContent;
  at("ellipse-legend").textContent = `ellipse: 95 %${longer >= 0 ? `, half axes ${metres(longer)} × ${metres(shorter)} m` : ""}`;
}

// The gravest first. What an alarm is about stays the same while the numbers in its text change.
function showAlarms(news, old) {
  const all = [
    ...news.limits.map((a) => ["wrong", a.text, `${a.kind} ${a.text.replace(/[\d.]+/g, "")}`]),
    ...news.alarms.map((a) => [a.severity, `${a.text.startsWith(`${a.sensor}:`) ? "" : `${a.sensor}: `}${a.text}`, `${a.sensor} ${a.kind} ${a.severity}`]),
  ].sort((a, b) => (b[0] === "wrong") - (a[0] === "wrong"));
  const red = [...(old ? ["old"] : []), ...(news.lock_lost_s > 0 ? ["lock"] : [])].map((name) => [name, "wrong"]);
  siren.tell([...all.map(([severity, , name]) => [name, severity]), ...red]);
  const lines = all.slice(0, SHOWN_ALARMS);
  if (all.length > SHOWN_ALARMS) lines.push(["more", `and ${all.length - SHOWN_ALARMS} more, see the events`]);
  const shown = at("alarms").children;
  while (shown.length > lines.length) shown[lines.length].remove();
  lines.forEach(([severity, text], k) => {
    if (!shown[k]) at("alarms").append(element("p"));
    if (shown[k].textContent !== text) shown[k].textContent = text;
    shown[k].className = severity;
  });
}

function addEvents(events) {
  for (const event of events) {
    if (event.kind === "resumed") gauges.resumed = true;
    at("events").prepend(element("li", `${clock(event.time)} ${event.source} ${event.kind}: ${event.text}`));
  }
  while (at("events").children.length > SHOWN_EVENTS) at("events").lastChild.remove();
}

// Distance and bearing from the vehicle.
function away(north, east) {
  const [n, e] = [north - state.north, east - state.east];
  return `${metres(Math.hypot(n, e))} m, ${bearing(Math.atan2(e, n))}`;
}

const markRows = new Map();

function showMarks(marks) {
  at("no-marks").hidden = marks.length > 0;
  for (const [number, row] of markRows) {
    if (marks.some((mark) => mark.number === number)) continue;
    row.remove();
    markRows.delete(number);
  }
  for (const mark of marks) {
    let row = markRows.get(mark.number);
    if (!row) {
      row = element("li");
      const [choose, remove] = [element("button"), element("button", "×")];
      choose.addEventListener("click", () => {
        map.selected = map.selected === mark.number ? null : mark.number;
        map.changed();
      });
      remove.setAttribute("aria-label", `Remove ${mark.name || mark.number}`);
      remove.addEventListener("click", () => command(`api/marks/${mark.number}`, "DELETE"));
      row.append(choose, remove);
      markRows.set(mark.number, row);
      at("marks").append(row);
    }
    const text = `${mark.name || mark.number}: ${away(mark.north, mark.east)}`;
    if (row.firstChild.textContent !== text) row.firstChild.textContent = text;
    row.firstChild.setAttribute("aria-pressed", `${map.selected === mark.number}`);
  }
}

async function command(address, method, body) {
  try {
    await link.ask(address, method, body);
  } catch (error) {
    answer(error.message);
  }
}

let hiding = 0;

function answer(text) {
  at("answer").textContent = text;
  at("answer").hidden = false;
  clearTimeout(hiding);
  hiding = setTimeout(() => { at("answer").hidden = true; }, 6000);
}

// A dialog; resolves to the value of the button that closed it.
function asked(id) {
  return new Promise((resolve) => {
    const dialog = at(id);
    dialog.returnValue = "";
    dialog.addEventListener("close", () => resolve(dialog.returnValue), { once: true });
    dialog.showModal();
  });
}

async function askName(title, where) {
  at("mark-title").textContent = title;
  at("mark-place").textContent = where;
  at("mark-name").value = "";
  return (await asked("mark-dialog")) === "save" ? at("mark-name").value : null;
}

async function dropMark() {
  if (!state) return answer("there is no position yet");
  await command("api/marks", "POST", { name: "" });
  return answer(`marked where the vehicle is; sd ${metres(state.ellipse_sd)} m`);
}

async function tapped([north, east]) {
  at("map").focus();
  if (!state) return;
  const where = `north ${metres(north)} m, east ${metres(east)} m; from the vehicle ${away(north, east)}`;
  at("point-place").textContent = where;
  const wanted = await asked("point-dialog");
  if (wanted === "waypoint") {
    const name = await askName("Way-point", where);
    if (name !== null) await command("api/marks", "POST", { name, north, east });
  } else if (wanted === "position") {
    at("position-place").textContent = where;
    at("position-sd").oninput = () => showDoubt(north, east);
    showDoubt(north, east);
    const sd = (await asked("position-dialog")) === "save" ? at("position-sd").valueAsNumber : NaN;
    if (sd > 0) await command("api/position", "POST", { north, east, sd });
  }
}

// How far a place is from the estimate, in units of what both are uncertain by.
function showDoubt(north, east) {
  const own = at("position-sd").valueAsNumber || 0;
  const [n, e] = [north - state.north, east - state.east];
  const [a, b, c] = [state.north_sd ** 2 + own ** 2, state.east_sd ** 2 + own ** 2, state.cov_north_east];
  const apart = Math.sqrt(Math.max(0, (b * n * n - 2 * c * n * e + a * e * e) / (a * b - c * c)));
  const text = `${apart.toFixed(1)} sd from the estimate.`;
  const doubt = " The estimate will take it for an outlier and refuse it; a larger standard deviation is needed.";
  at("position-doubt").textContent = apart > GATE ? text + doubt : text;
}

async function loadCharts() {
  try {
    const { charts } = await (await link.ask("api/charts")).json();
    map.charts = charts.map((chart) => ({ shapes: chart.shapes, images: images(chart) }));
    at("chart-missing").hidden = true;
  } catch (error) {
    at("chart-missing").textContent = `no chart: ${error.message}`;
    at("chart-missing").hidden = false;
  }
  map.changed();
}

function images(chart) {
  const all = chart.tiles?.map(({ tile, corners }) => [`api/charts/${chart.number}/${tile.join("/")}.png`, corners])
    ?? (chart.corners ? [[`api/charts/${chart.number}.png`, chart.corners]] : []);
  return all.map(([address, corners]) => {
    const image = new Image();
    image.onload = () => map.changed();
    link.ask(address).then((found) => found.blob()).then((blob) => { image.src = URL.createObjectURL(blob); })
      .catch((error) => answer(`${chart.name}: ${error.message}`));
    return { element: image, corners };
  });
}

function showButtons() {
  at("follow").setAttribute("aria-pressed", `${map.follow}`);
  at("heading-up").setAttribute("aria-pressed", `${map.headingUp}`);
}

function toggle(name) {
  map[name] = !map[name];
  showButtons();
  map.show(state);
}

const actions = {
  "zoom-in": () => map.zoom(1.5),
  "zoom-out": () => map.zoom(1 / 1.5),
  follow: () => toggle("follow"),
  "heading-up": () => toggle("headingUp"),
  fit: () => map.fit(),
  "drop-mark": dropMark,
};
for (const [id, action] of Object.entries(actions)) at(id).addEventListener("click", action);

const keys = {
  "+": actions["zoom-in"], "=": actions["zoom-in"], "-": actions["zoom-out"],
  f: actions.follow, h: actions["heading-up"], a: actions.fit, m: dropMark,
  ArrowLeft: () => map.pan(60, 0), ArrowRight: () => map.pan(-60, 0),
  ArrowUp: () => map.pan(0, 60), ArrowDown: () => map.pan(0, -60),
};
at("map").addEventListener("keydown", (event) => {
  const action = event.ctrlKey || event.metaKey || event.altKey ? null : keys[event.key];
  if (!action) return;
  event.preventDefault();
  action();
});

at("login").addEventListener("submit", (event) => {
  event.preventDefault();
  link.use(at("token").value.trim());
});

at("sd-legend").append(...palette.sd.map((_, k) => {
  const last = k === palette.sd.length - 1;
  const row = element("span", last ? "more" : `${colourEnd(k)}`);
  row.style.borderBottomColor = `var(--sd-${k})`;
  return row;
}));

function showClock() {
  at("wall-clock").textContent = new Date().toTimeString().slice(0, 8);
}
setInterval(showClock, 1000);
showClock();

document.body.classList.toggle("widget", widget);
window.rovgraph = { map, siren }; // for tests, and for a look by the developers' tools
loadChartsNote();

async function loadChartsNote() {
  const known = await link.ask("api/charts").then((answered) => answered.json()).catch(() => null);
  if (!known?.missing || chartsPlaced) return;
  at("chart-missing").textContent = known.missing;
  at("chart-missing").hidden = false;
}
