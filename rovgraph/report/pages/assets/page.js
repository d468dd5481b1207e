"use strict";
// Draws the panels of a page when they come into view, and keeps one cursor over all of them.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const drawn = new Map(); // key -> {panel, plot, layer, series, readout}
  const svg = "http://www.w3.org/2000/svg";
  let now = 0; // time of the cursor, in the unit of the page's clock
  let range = null; // of every time axis; null = the whole dive

  const unpack = (text) => { // float64 behind a colon, else float32
    const far = text[0] === ":", bytes = Uint8Array.from(atob(far ? text.slice(1) : text), (c) => c.charCodeAt(0));
    const view = new DataView(bytes.buffer);
    if (far) return Float64Array.from({ length: bytes.length / 8 }, (_, i) => view.getFloat64(8 * i, true));
    return Float32Array.from({ length: bytes.length / 4 }, (_, i) => view.getFloat32(4 * i, true));
  };
  const unpackAll = (packed) => Object.fromEntries(Object.entries(packed).map(([k, v]) => [k, unpack(v)]));
  const cursor = data.cursor ? unpackAll(data.cursor) : null;

  // Index of the last time at or before t.
  const before = (times, t) => {
    let low = 0, high = times.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times[middle] <= t) low = middle; else high = middle - 1;
    }
    return low;
  };
  const at = (times, values, t) => {
    const i = before(times, t), j = Math.min(i + 1, times.length - 1);
    const span = times[j] - times[i];
    const share = span > 0 ? Math.min(Math.max((t - times[i]) / span, 0), 1) : 0;
    return values[i] + share * (values[j] - values[i]);
  };
  const nearest = (times, t) => {
    const i = before(times, t), j = Math.min(i + 1, times.length - 1);
    return Math.abs(times[j] - t) < Math.abs(times[i] - t) ? j : i;
  };
  // A thousandth of what an axis spans is its last digit; less than that is 0.
  const number = (v, span) => {
    if (!Number.isFinite(v)) return "unknown";
    if (!(span > 0)) return String(+v.toPrecision(4));
    const digits = Math.min(Math.max(3 - Math.ceil(Math.log10(span)), 0), 9);
    return Math.abs(v) < span / 1000 ? "0" : v.toFixed(digits).replace("-", "−");
  };
  const plusMinus = (v, sd) => { // two digits of the sd
    const digits = Math.min(Math.max(1 - Math.floor(Math.log10(sd)), 0), 9);
    return `${Math.abs(v) < sd / 1000 ? "0" : v.toFixed(digits).replace("-", "−")} ± ${sd.toFixed(digits)}`;
  };
  const spanOf = (axis) => (axis.type === "log" ? NaN : Math.abs(axis.range[1] - axis.range[0]));
  const unitOf = (label) => (/\[(.+)\]/.exec(label) || ["", ""])[1];
  const narrow = () => innerWidth < 700;
  const metres = (v) => (Number.isFinite(v) ? (Math.abs(v) < 0.005 ? 0 : v).toFixed(Math.abs(v) < 100 ? 2 : 1).replace("-", "−") : "unknown");

  // ---- drawing -------------------------------------------------------------------------------
  const axis = (title, log, ticks) => ({
    title: { text: title, font: { size: 13 }, standoff: 8 }, automargin: true, zeroline: false, linecolor: "#888",
    gridcolor: "#e4e4e4", type: log ? "log" : "linear", tickfont: { size: 12 }, nticks: log ? undefined : ticks, exponentformat: "none",
  });
  // Numbers on a logarithmic axis: powers of ten over many decades, 1 2 5 over a few, all digits within one.
  const logTicks = (series, key) => {
    let low = Infinity, high = 0;
    for (const s of series) for (const v of s[key]) if (v > 0) { low = Math.min(low, v); high = Math.max(high, v); }
    if (!(high > 0)) return {};
    const decades = Math.log10(high / low), digits = decades > 3 ? [1] : decades > 0.9 ? [1, 2, 5] : [1, 2, 3, 4, 5, 6, 7, 8, 9];
    const tickvals = [];
    for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k++) for (const d of digits) tickvals.push(+`${d}e${k}`);
    if (tickvals.filter((v) => v >= low && v <= high).length < 2) { // hardly any span: round steps
      const power = 10 ** Math.floor(Math.log10((high - low) / 2)), step = [5, 2, 1].map((d) => d * power).find((d) => 2 * d <= high - low) || power;
      tickvals.length = 0;
      for (let k = Math.ceil(low / step); k * step <= high; k++) tickvals.push(+(k * step).toPrecision(6));
    }
    const told = (v) => (v >= 1e-3 && v < 1e5 ? String(v) : v.toExponential(0).replace(/^1e\+?(-?\d+)$/, "10<sup>$1</sup>"));
    return { tickvals, ticktext: tickvals.map(told), tickmode: "array" };
  };
  const layoutOf = (panel, series) => {
    const plain = (v) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: v, y1: v, line: { color: "#666", width: 1, dash: "dot" } });
    const shaded = ([from, to, colour]) => ({ type: "rect", yref: "paper", y0: 0, y1: 1, x0: from, x1: to,
      fillcolor: colour, opacity: 0.18, line: { width: 0 }, layer: "below" });
    const layout = {
      margin: { l: narrow() ? 46 : 60, r: 12, t: 6, b: 44 }, dragmode: narrow() ? false : "zoom", font: { family: "system-ui, sans-serif", color: "#1c1c1c" },
      xaxis: axis(panel.x, panel.log.includes("x"), 12), yaxis: axis(panel.y, panel.log.includes("y"), panel.kind === "map" ? 12 : 6),
      hovermode: "closest", bargap: 0, barmode: "overlay", showlegend: panel.traces.filter((t) => t.name && t.showlegend !== false).length > (panel.kind === "map" ? 0 : 1),
      legend: { orientation: "h", y: 1, yanchor: "bottom", x: 0, font: { size: 12 } },
      shapes: [...panel.levels.map(plain), ...panel.spans.map(shaded)], uirevision: "kept",
    };
    for (const key of panel.log) Object.assign(layout[`${key}axis`], logTicks(series, key));
    if (panel.ticks.length) Object.assign(layout.yaxis, { tickvals: panel.ticks });
    if (panel.limits) layout.yaxis.range = panel.down ? [...panel.limits].reverse() : [...panel.limits];
    else if (panel.down) layout.yaxis.autorange = "reversed";
    if (panel.limits && panel.y.startsWith("heading [") && panel.limits[1] - panel.limits[0] > 220)
      Object.assign(layout.yaxis, { tick0: 0, dtick: 90 });
    if (panel.kind === "time") layout.xaxis.range = range || [0, data.clock.end];
    if (panel.names.length) Object.assign(layout.yaxis, { tickvals: panel.names.map((_, i) => i + 1), ticktext: panel.names,
      range: [panel.names.length + 0.7, 0.3] });
    if (panel.kind === "map" || panel.kind === "plan") Object.assign(layout.yaxis, { scaleanchor: "x", scaleratio: 1 });
    if (panel.kind === "map") {
      if (narrow()) { Object.assign(layout, { showlegend: false }); layout.xaxis.nticks = 5; layout.yaxis.nticks = 6; }
      if (data.origin && !narrow()) graticule(layout, null);
    }
    return layout;
  };
  const traceOf = (panel, trace) => {
    const digits = panel.kind === "map" ? ".2f" : ".4g";
    const arrays = { x: unpack(trace.x), y: unpack(trace.y) };
    if (trace.t) arrays.t = unpack(trace.t);
    if (trace.value) arrays.value = arrays.customdata = unpack(trace.value); // what is told in the place of y
    if (trace.sd) arrays.sd = unpack(trace.sd);
    const unit = unitOf(panel.y);
    const told = panel.kind !== "map" ? `%{x:${digits}}, %{${trace.value ? "customdata" : "y"}:${digits}} ${unit}`
      : `east %{x:.2f} m, north %{y:.2f} m${trace.value ? "<br>sd %{customdata:.2g} m" : ""}`;
    const plain = String(trace.name ?? "").replaceAll("&", "&amp;").replaceAll("<", "&lt;"); // Plotly takes tags in names
    return { type: "scatter", connectgaps: false, hovertemplate: trace.hoverinfo ? undefined : told, ...trace, ...arrays, name: plain, label: trace.name };
  };

  // A line with an sd has a band of so many of them to each side: a closed shape for each part without a gap.
  const withBand = (s) => {
    if (!s.sd) return [s];
    const x = [], y = [], known = (i) => Number.isFinite(s.y[i]) && Number.isFinite(s.sd[i]);
    for (let from = 0, to; from < s.x.length; from = to + 1) {
      for (to = from; to < s.x.length && known(to); to++) { x.push(s.x[to]); y.push(s.y[to] + s.band * s.sd[to]); }
      for (let i = to - 1; i >= from; i--) { x.push(s.x[i]); y.push(s.y[i] - s.band * s.sd[i]); }
      if (to > from) { x.push(NaN); y.push(NaN); }
    }
    const band = { type: "scatter", mode: "lines", name: s.name, x, y, line: { width: 0, color: s.line.color }, fill: "toself",
      fillcolor: s.line.color + "2e", showlegend: false, legendgroup: s.label, hoverinfo: "skip", quiet: true,
      label: `${s.label} ± ${s.band} sd` };
    return [band, { ...s, legendgroup: s.label }];
  };

  const draw = async (figure) => {
    const key = figure.dataset.panel;
    if (drawn.has(key)) return;
    const panel = data.panels[key], plot = figure.querySelector(".plot");
    const series = panel.traces.map((trace) => traceOf(panel, trace)).flatMap(withBand);
    const entry = { panel, plot, series, readout: figure.querySelector(".readout") };
    drawn.set(key, entry);
    if (panel.names.length && panel.kind !== "time") plot.style.height = `${110 + 22 * panel.names.length}px`;
    const options = { responsive: true, displaylogo: false, plotlyServerURL: "", displayModeBar: narrow() ? false : "hover", scrollZoom: false,
      toImageButtonOptions: { format: "png", scale: 2, filename: key },
      modeBarButtonsToRemove: ["select2d", "lasso2d", "autoScale2d", "zoom2d", "zoomIn2d", "zoomOut2d", "sendChartToCloud"], modeBarButtonsToAdd: [exportButton(entry)] };
    // an axis shows only where something stands over it
    const degrees = panel.kind === "map" && data.origin && !narrow() ? [{ x: [null], y: [null], xaxis: "x2", yaxis: "y2", showlegend: false, hoverinfo: "skip", mode: "markers" }] : [];
    await Plotly.newPlot(plot, [...series, ...degrees], layoutOf(panel, series), options);
    plot.querySelectorAll(".modebar-btn").forEach((b) => { b.setAttribute("role", "button"); b.setAttribute("aria-label", b.dataset.title || "tool"); });
    entry.layer = plot.appendChild(document.createElementNS(svg, "svg"));
    entry.layer.setAttribute("class", "cursor");
    entry.layer.setAttribute("aria-hidden", "true");
    plot.on("plotly_relayout", (change) => relayout(entry, change));
    plot.on("plotly_afterplot", () => mark(entry));
    plot.on("plotly_hover", (event) => {
      const point = event.points[0], times = series[point.curveNumber].t;
      if (times) setTime(times[point.pointNumber]);
    });
    if (panel.kind === "time") plot.addEventListener("pointermove", (event) => {
      const x = plot._fullLayout.xaxis, t = x.p2d(event.clientX - plot.getBoundingClientRect().left - x._offset);
      if (t >= x.range[0] && t <= x.range[1]) setTime(t);
    });
    if (degrees.length) await regrid(entry);
    mark(entry);
  };
  const exportButton = (entry) => ({
    name: "csv", title: "Download what is drawn as CSV",
    icon: { width: 24, height: 24, path: "M5 20h14v-2H5v2zM19 9h-4V3H9v6H5l7 7 7-7z" },
    click: () => {
      const quoted = (s) => `"${String(s).replaceAll('"', '""')}"`;
      const lines = [["series", entry.panel.x, entry.panel.y].map(quoted).join(",")];
      for (const s of entry.series) for (let i = 0; i < s.x.length; i++) lines.push(`${quoted(s.label)},${s.x[i]},${(s.value || s.y)[i]}`);
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([lines.join("\n") + "\n"], { type: "text/csv" }));
      link.download = entry.panel.title.replace(/[^\w-]+/g, "_") + ".csv";
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    },
  });

  // ---- zoom of all time axes together --------------------------------------------------------
  let following = false;
  const relayout = (entry, change) => {
    if (entry.panel.kind === "map") { place(entry); if (data.origin && !following && entry.plot._fullLayout.xaxis2) regrid(entry); }
    if (following || entry.panel.kind !== "time") return mark(entry);
    if (change["xaxis.autorange"]) return zoom(null);
    if ("xaxis.range[0]" in change) return zoom([change["xaxis.range[0]"], change["xaxis.range[1]"]]);
    mark(entry);
  };
  const zoom = async (wanted) => {
    range = wanted;
    following = true;
    const shown = range || [0, data.clock.end];
    for (const entry of drawn.values())
      if (entry.panel.kind === "time" && entry.layer) await Plotly.relayout(entry.plot, { "xaxis.range": [...shown] });
    following = false;
    markAll();
  };

  // ---- latitude and longitude ----------------------------------------------------------------
  const STEPS = [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600];
  const degrees = (value, letters, step) => {
    const digits = step < 0.01 ? 3 : step < 0.1 ? 2 : step < 1 ? 1 : 0;
    let seconds = +(Math.abs(value) * 3600).toFixed(digits);
    const d = Math.floor(seconds / 3600), m = Math.floor((seconds - 3600 * d) / 60);
    seconds -= 3600 * d + 60 * m;
    return `${d}°${String(m).padStart(2, "0")}′${seconds.toFixed(digits)}″${letters[value < 0 ? 1 : 0]}`;
  };
  const lines = ([low, high], origin, metres, letters, most) => {
    const from = (origin + low / metres) * 3600, to = (origin + high / metres) * 3600;
    const step = STEPS.find((s) => (to - from) / s <= most) || 3600;
    const seconds = [];
    for (let k = Math.ceil(from / step); k * step <= to; k++) seconds.push(k * step);
    return { tickvals: seconds.map((s) => (s / 3600 - origin) * metres), ticktext: seconds.map((s) => degrees(s / 3600, letters, step)) };
  };
  const graticule = (layout, ranges) => {
    const o = data.origin, all = (k) => { const v = cursor[k].filter(Number.isFinite); return v.length ? [v.reduce((a, b) => Math.min(a, b)), v.reduce((a, b) => Math.max(a, b))] : [0, 1]; };
    const [x, y] = ranges || [all("east"), all("north")];
    const common = { overlaying: "x", showgrid: true, gridcolor: "#b5c9d6", griddash: "dot", tickfont: { size: 10, color: "#3d5a6c" }, zeroline: false, tickmode: "array", automargin: true };
    layout.xaxis2 = { ...common, side: "top", matches: "x", ...lines(x, o.lon, o.lon_m, "EW", innerWidth < 700 ? 2 : 5) };
    layout.yaxis2 = { ...common, overlaying: "y", side: "right", matches: "y", ...lines(y, o.lat, o.lat_m, "NS", 6) };
    layout.legend = { orientation: "h", y: -0.1, yanchor: "top", x: 0, font: { size: 12 } };
  };
  const regrid = async (entry) => {
    const full = entry.plot._fullLayout, layout = {};
    graticule(layout, [full.xaxis.range, full.yaxis.range]);
    following = true;
    await Plotly.relayout(entry.plot, { "xaxis2.tickvals": layout.xaxis2.tickvals, "xaxis2.ticktext": layout.xaxis2.ticktext,
      "yaxis2.tickvals": layout.yaxis2.tickvals, "yaxis2.ticktext": layout.yaxis2.ticktext });
    following = false;
  };

  // ---- the cursor ----------------------------------------------------------------------------
  const add = (layer, tag, attributes) => {
    const element = document.createElementNS(svg, tag);
    for (const [k, v] of Object.entries(attributes)) element.setAttribute(k, v);
    return layer.appendChild(element);
  };
  const pixel = (entry, x, y) => {
    const { xaxis, yaxis } = entry.plot._fullLayout;
    return [xaxis._offset + xaxis.d2p(x), yaxis._offset + yaxis.d2p(y)];
  };
  const mark = (entry) => {
    if (!entry.layer) return;
    entry.layer.replaceChildren();
    if (entry.panel.kind === "map") { place(entry); return; }
    if (!data.clock) return;
    if (entry.panel.kind === "time") return markTime(entry);
    for (const s of entry.series) if (s.t && s.visible !== "legendonly") {
      const i = nearest(s.t, now), [x, y] = pixel(entry, s.x[i], s.y[i]);
      if (Number.isFinite(x + y)) add(entry.layer, "circle", { cx: x, cy: y, r: 6, fill: "none", stroke: "#000", "stroke-width": 2 });
    }
  };
  const markTime = (entry) => {
    const { xaxis, yaxis } = entry.plot._fullLayout;
    if (now < xaxis.range[0] || now > xaxis.range[1]) { entry.readout.textContent = ""; return; }
    const x = xaxis._offset + xaxis.d2p(now);
    add(entry.layer, "line", { x1: x, x2: x, y1: yaxis._offset, y2: yaxis._offset + yaxis._length, stroke: "#000", "stroke-width": 1 });
    const named = (s) => (/\d$/.test(s.label) ? `${s.label}:` : s.label); // a number beside a number
    const near = (xaxis.range[1] - xaxis.range[0]) / 200; // under the mouse; a line is known between its points
    const here = (s) => s.x.length && (s.mode !== "markers" || Math.abs(s.x[nearest(s.x, now)] - now) <= near);
    const log = entry.panel.log.includes("y") || entry.panel.ticks.length, span = log ? NaN : spanOf(yaxis), unit = unitOf(entry.panel.y);
    const tell = (s) => {
      const i = nearest(s.x, now), value = (s.value || s.y)[i], sd = s.sd ? s.sd[i] : NaN;
      if (!Number.isFinite(value)) return `${named(s)} unknown`;
      const shown = sd > 0 ? plusMinus(value, sd) : number(value, s.value ? NaN : span);
      return `${named(s)} ${shown}${unit === "°" ? "" : unit && " "}${unit}`;
    };
    const told = entry.series.filter((s) => !s.quiet && s.visible !== "legendonly" && here(s)).map(tell);
    entry.readout.textContent = `at ${+now.toFixed(data.clock.unit === "s" ? 1 : 2)} ${data.clock.unit}: ${told.join(" · ") || "nothing was measured"}`;
  };
  const place = (entry) => { // the vehicle with its ellipse, and the scale bar
    if (!entry.layer || !entry.plot._fullLayout.xaxis._length) return;
    entry.layer.replaceChildren();
    const { xaxis, yaxis } = entry.plot._fullLayout, perMetre = xaxis._length / (xaxis.range[1] - xaxis.range[0]);
    scaleBar(entry.layer, xaxis, yaxis, perMetre);
    if (!cursor) return;
    const v = vehicle(now);
    const [x, y] = pixel(entry, v.east, v.north);
    if (!Number.isFinite(x + y)) return;
    const group = add(entry.layer, "g", { class: "vehicle", "data-x": x, "data-y": y });
    if (Number.isFinite(v.major)) add(group, "ellipse", { cx: x, cy: y, rx: v.major * perMetre, ry: v.minor * perMetre,
      transform: `rotate(${(v.bearing * 180) / Math.PI - 90} ${x} ${y})`, fill: "#0072B222", stroke: "#0072B2", "stroke-width": 1.5 });
    const heading = Number.isFinite(v.yaw) ? (v.yaw * 180) / Math.PI : 0;
    add(group, "path", { d: "M0,-13 L8,10 L0,5 L-8,10 Z", transform: `translate(${x} ${y}) rotate(${heading})`, fill: "#000", stroke: "#fff", "stroke-width": 1.5 });
  };
  const scaleBar = (layer, xaxis, yaxis, perMetre) => {
    const most = Math.max(60, xaxis._length / 5) / perMetre, power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((k) => k * power).find((k) => k <= most) || power;
    const x = xaxis._offset + 12, y = yaxis._offset + yaxis._length - 14;
    add(layer, "rect", { x: x - 5, y: y - 22, width: length * perMetre + 10, height: 30, fill: "#ffffffcc" });
    add(layer, "path", { d: `M${x},${y - 5} v5 h${length * perMetre} v-5`, fill: "none", stroke: "#000", "stroke-width": 2 });
    add(layer, "text", { x, y: y - 8, "font-size": 12, fill: "#000", class: "scale" }).textContent = length >= 1000 ? `${length / 1000} km` : `${length} m`;
  };
  const vehicle = (t) => {
    const found = Object.fromEntries(["north", "east", "down", "yaw", "major", "minor"].map((k) => [k, at(cursor.time, cursor[k], t)]));
    found.bearing = cursor.bearing[nearest(cursor.time, t)];
    return found;
  };

  let asked = false;
  const markAll = () => {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      for (const entry of drawn.values()) {
        const box = entry.plot.getBoundingClientRect();
        if (box.bottom > -50 && box.top < innerHeight + 50) mark(entry);
      }
      tell();
    });
  };
  const slider = document.getElementById("time"), output = document.getElementById("now");
  const setTime = (t) => {
    if (!data.clock) return;
    now = Math.min(Math.max(t, 0), data.clock.end); slider.value = now;
    markAll();
  };
  const tell = () => {
    const unit = data.clock.unit;
    let text = `${now.toFixed(unit === "s" ? 1 : 2)} ${unit}`;
    if (cursor) {
      const v = vehicle(now), heading = (((v.yaw * 180) / Math.PI) % 360 + 360) % 360;
      text += ` · ${narrow() ? "N" : "north"} ${metres(v.north)} m, ${narrow() ? "E" : "east"} ${metres(v.east)} m, ${narrow() ? "" : "depth "}${metres(v.down)} m ${narrow() ? "deep · " : "· heading "}${Number.isFinite(heading) ? heading.toFixed(1) + "°" : "unknown"}`;
      if (!narrow()) text += Number.isFinite(v.major) ? ` · 99 % within ${metres(v.major)} × ${metres(v.minor)} m` : "";
      if (data.origin && !narrow()) text += ` · ${degrees(data.origin.lat + v.north / data.origin.lat_m, "NS", 0.05)} ${degrees(data.origin.lon + v.east / data.origin.lon_m, "EW", 0.05)}`;
    }
    output.textContent = text;
    slider.setAttribute("aria-valuetext", text);
  };

  const figures = [...document.querySelectorAll("figure[data-panel]")];
  if (data.clock) {
    document.getElementById("cursor").hidden = false;
    slider.max = data.clock.end;
    slider.step = data.clock.end / 2000 || "any";
    slider.addEventListener("input", () => setTime(+slider.value));
    document.getElementById("closer").addEventListener("click", () => {
      const [from, to] = range || [0, data.clock.end], half = (to - from) / 4;
      zoom([now - half, now + half]);
    });
    document.getElementById("all").addEventListener("click", () => zoom(null));
    setTime(0);
    addEventListener("scroll", markAll, { passive: true });
  }
  const seen = new IntersectionObserver((entries) => {
    for (const e of entries) if (e.isIntersecting) { seen.unobserve(e.target); draw(e.target); }
  }, { rootMargin: "400px" });
  figures.forEach((f) => seen.observe(f)); // one that is folded comes into view when it is opened
  const unfold = () => {
    const section = location.hash.length > 1 && document.getElementById(decodeURIComponent(location.hash.slice(1)));
    const fold = section && section.querySelector(":scope > details.fold");
    if (fold && !fold.open) { fold.open = true; section.scrollIntoView(); }
  };
  addEventListener("hashchange", unfold);
  document.querySelectorAll("nav a").forEach((a) => a.addEventListener("click", () => setTimeout(unfold)));
  document.querySelectorAll("details.fold").forEach((d) => d.addEventListener("toggle", () => { // the window may have changed meanwhile
    if (d.open) for (const entry of drawn.values()) if (d.contains(entry.plot) && entry.layer) Plotly.Plots.resize(entry.plot);
  }));
  unfold();

  // ---- the printed page has the map alone ----------------------------------------------------
  const map = document.getElementById("track");
  const resizeMap = (size) => { const e = drawn.get("track"); if (e && e.layer) Plotly.relayout(e.plot, size); };
  addEventListener("beforeprint", () => { if (map && map.dataset.panel) resizeMap({ width: 680, height: 560 }); });
  addEventListener("afterprint", () => resizeMap({ width: undefined, height: undefined, autosize: true }));

  const drawAll = async () => {
    document.querySelectorAll("details.fold").forEach((d) => { d.open = true; });
    for (const f of figures) await draw(f);
  };
  window.rovgraph = { drawn, draw, drawAll, setTime, zoom, vehicle };
})();
