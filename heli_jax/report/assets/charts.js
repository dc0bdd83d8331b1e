// The page's own drawing of its figures by uPlot: zoomed by dragging, read by hovering, cursors linked.
"use strict";
(() => {
  const numbers = JSON.parse(document.getElementById("numbers").textContent);
  const decoded = new Map();
  const night = matchMedia("(prefers-color-scheme: dark)");
  // Of Okabe and Ito's colours those that are too dark on a dark page, and the greys.
  const NIGHT = { "#000000": "#e4e4e2", "#0072b2": "#5cb3ea", "#56b4e9": "#bfe3fb", "#d55e00": "#ff8a3d", "#a8a8a8": "#8a8a8a",
    "#6b6b6b": "#a0a0a0", "#444444": "#b0b0b0", "#7f7f7f": "#a0a0a0", "#009e73": "#2fc79a" };
  const paper = () => document.documentElement.classList.contains("printing");
  const shown = color => night.matches && !paper() ? NIGHT[color.toLowerCase()] ?? color : color;
  const style = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  function bytes(text) {
    const raw = atob(text), out = new Uint8Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw.charCodeAt(i);
    return out.buffer;
  }

  // An array of the page, with null where a number is missing, as uPlot has it.
  function array(i) {
    if (!decoded.has(i)) {
      const a = numbers.arrays[i];
      let values;
      if ("n" in a) values = Array.from({ length: a.n }, (_, k) => a.from + a.step * k);
      else if ("f" in a) values = Array.from(new Float32Array(bytes(a.f)), v => Number.isNaN(v) ? null : v);
      else values = Array.from(new Uint16Array(bytes(a.q)), v => v === 65535 ? null : a.low + a.step * v);
      decoded.set(i, values);
    }
    return decoded.get(i);
  }

  // As the tables of the page have it: 1.7·10⁻⁴, with a true minus sign.
  function powered(value, power, digits) {
    const raised = [...String(power)].map(c => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]).join("");
    const size = +(value / 10 ** power).toFixed(digits);
    return size ? `${size}·10${raised}`.replace("-", "−") : "0";
  }

  // The numbers of an axis; all with one power of ten.
  function ticks(splits) {
    const size = Math.max(...splits.map(v => Math.abs(v ?? 0))), power = Math.floor(Math.log10(size || 1));
    // Zoomed in on a small part of a large number the last digits are those that differ.
    const step = Math.abs(splits.at(-1) - splits[0]) || size, digits = Math.max(4, 2 + power - Math.floor(Math.log10(step || 1)));
    if (power < -3 || power > 5) return splits.map(v => v == null ? null : powered(v, power, Math.min(digits, 12)));
    return splits.map(v => v == null ? null : String(+v.toFixed(8)).replace("-", "−"));
  }

  // As many digits as the range leaves sense to: five.
  function text(value, span) {
    if (value == null || !Number.isFinite(value)) return "–";
    const size = Math.max(span, 1e-12), power = Math.floor(Math.log10(size));
    if (power < -4 || power > 5) return powered(value, power, 3);
    return value.toFixed(Math.max(0, 4 - power)).replace("-", "−");
  }

  const groups = new Map();
  // uPlot draws what is missing at one series' x but not at another's as a line through.
  const near = (u, i, k) => {
    const y = u.data[i];
    if (y[k] != null) return k;
    for (let d = 1; d < y.length; d++) {
      if (y[k - d] != null) return k - d;
      if (y[k + d] != null) return k + d;
    }
    return k;
  };

  function columns(panel) {
    const tables = [], of = [];
    for (const s of panel.series) {
      const table = [array(s.x), array(s.y)];
      const extra = s.low != null ? [array(s.low), array(s.high)] : [];
      of.push(extra.length);
      tables.push([...table, ...extra]);
    }
    const same = tables.every(t => t[0] === tables[0][0]);
    const data = same ? [tables[0][0], ...tables.flatMap(t => t.slice(1))] : uPlot.join(tables);
    return { data, of };
  }

  function seriesOf(panel, of, unit) {
    const list = [{}], bands = [], bars = [];
    const span = panel.limits[1] - panel.limits[0];
    const value = (u, v) => v == null ? "–" : text(v, span) + (unit ? ` ${unit}` : "");
    panel.series.forEach((s, k) => {
      const at = list.length, points = s.kind === "points" || s.kind === "bars";
      list.push({
        label: s.label, stroke: () => shown(s.color), value, spanGaps: false,
        width: points ? 0 : Math.max(1, s.width), dash: s.dashed ? [7, 4] : undefined,
        class: s.kind === "band" ? "unlisted" : "listed",
        paths: points ? () => null : s.kind === "step" ? uPlot.paths.stepped({ align: 1 }) : uPlot.paths.linear(),
        points: { show: points, size: 2 + s.width, fill: () => shown(s.color), width: 0 },
      });
      if (!of[k]) return;
      for (let j = 0; j < 2; j++) {
        list.push({ label: "", class: "unlisted", width: 0, stroke: "transparent", paths: uPlot.paths.linear(), points: { show: false } });
      }
      if (s.kind === "band") {
        list[at].width = 0;
        bands.push({ series: [at + 2, at + 1], fill: () => shown(s.color) + "66" });
      } else bars.push([at, s]);
    });
    return { list, bands, bars };
  }

  function decorate(u, chart, panel, bars) {
    const { ctx, bbox } = u, ratio = devicePixelRatio;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.lineWidth = ratio;
    ctx.setLineDash([4 * ratio, 3 * ratio]);
    ctx.strokeStyle = style("--strong");
    const stroke = (x0, y0, x1, y1) => { ctx.beginPath(); ctx.moveTo(x0, y0); ctx.lineTo(x1, y1); ctx.stroke(); };
    for (const y of panel.levels) stroke(bbox.left, u.valToPos(y, "y", true), bbox.left + bbox.width, u.valToPos(y, "y", true));
    ctx.setLineDash([]);
    for (const [at, s] of bars) {
      ctx.strokeStyle = shown(s.color);
      u.data[0].forEach((x, k) => {
        if (u.data[at][k] == null) return;
        const px = u.valToPos(x, "x", true);
        stroke(px, u.valToPos(u.data[at + 1][k], "y", true), px, u.valToPos(u.data[at + 2][k], "y", true));
      });
    }
    ctx.restore();
  }

  // 0.1, 0.2, 0.5, 1: with as few of them as do not crowd.
  function decades(u, at, low, high) {
    const many = Math.log10(high / low) * 3 * 45 > u.bbox.width / devicePixelRatio, all = [];
    for (let p = Math.floor(Math.log10(low)); p <= Math.ceil(Math.log10(high)); p++) {
      for (const m of many ? [1] : [1, 2, 5]) {
        const v = m * 10 ** p;
        if (v >= low && v <= high) all.push(v);
      }
    }
    return all;
  }

  function plot(chart, panel, place, last) {
    const { data, of } = columns(panel);
    const unit = (/\[(.*)\]$/.exec(panel.label) ?? [])[1]?.replace("–", "");
    const { list, bands, bars } = seriesOf(panel, of, unit);
    const x0 = data[0][0], x1 = data[0].at(-1);
    list[0] = { label: last ? chart.x_label.replace(/ \[.*/, "") : "", class: last ? "listed" : "unlisted",
      value: (u, v) => v == null ? "–" : `${text(v, u.scales.x.max - u.scales.x.min)} ${(/\[(.*)\]/.exec(chart.x_label) ?? [])[1] ?? ""}` };
    // What x will be: the plot itself has that only after y has been ranged, so at first nothing.
    let across = chart.x_limits;
    const xRange = (u, low, high) => across = low === x0 && high === x1 ? chart.x_limits : [low, high];
    // The limits of the figure while all is seen; zoomed, what is seen.
    const range = (u, low, high) => {
      const [first, last] = chart.x_limits, hair = 1e-9 * (last - first);
      const whole = across[0] <= first + hair && across[1] >= last - hair;
      if (whole || low == null) return panel.limits;
      // What stands still is shown with room for ticks of its own size, and not from -1 to 1.
      const margin = 0.06 * (high - low) || 0.1 * (panel.limits[1] - panel.limits[0]) || 1;
      return [low - margin, high + margin];
    };
    const axis = { stroke: () => style("--ink"), grid: { stroke: () => style("--grid"), width: 1 },
      ticks: { stroke: () => style("--grid"), size: 4 }, font: "12px system-ui, sans-serif" };
    const u = new uPlot({
      width: Math.max(260, place.clientWidth), height: panel.height + (last ? 52 : 10),
      padding: [8, 12, 0, 0], ms: 1e-3, series: list, bands,
      scales: { x: { time: false, distr: chart.logarithmic ? 3 : 1, range: xRange }, y: { range, distr: panel.logarithmic ? 3 : 1 } },
      axes: [{ ...axis, size: last ? 30 : 6, label: last ? chart.x_label : undefined, labelSize: 18, labelGap: 0, labelFont: axis.font, splits: chart.logarithmic ? decades : undefined, filter: chart.logarithmic ? (u, s) => s : undefined,
        values: last ? chart.logarithmic ? (u, s) => s.map(v => `${+v.toPrecision(2)}`) : undefined : () => [] }, { ...axis, size: (u, values) => Math.max(62, 16 + 6.8 * Math.max(0, ...(values ?? []).map(v => v?.length ?? 0))), space: 20, values: (u, splits) => panel.logarithmic ? splits.map(v => v == null ? null : `${+v.toPrecision(2)}`) : ticks(splits) }],
      legend: { markers: { width: 2, stroke: (u, i) => i ? u.series[i].stroke() : "transparent", fill: null } },
      cursor: { sync: { key: chart.group, scales: ["x", null], setSeries: false }, drag: { x: true, y: false }, dataIdx: near, focus: { prox: -1 }, points: { size: 6 } },
      hooks: { drawClear: [u => decorate(u, chart, panel, bars)] },
    }, data, place);
    u.chart = chart;
    return u;
  }

  const inGroup = chart => groups.get(chart.group);
  const own = chart => inGroup(chart).find(u => u.chart === chart);
  const zoom = (chart, low, high) => inGroup(chart).forEach(u => u.setScale("x", { min: low, max: high }));
  const reset = chart => inGroup(chart).forEach(u => u.setScale("x", { min: u.chart.x_limits[0], max: u.chart.x_limits[1] }));

  // Of a logarithmic axis in powers: half of it is half of its decades.
  function closer(chart, factor, about) {
    const { min, max } = own(chart).scales.x;
    const to = chart.logarithmic ? Math.log : v => v, back = chart.logarithmic ? Math.exp : v => v;
    const a = to(min), b = to(max), [first, last] = chart.x_limits.map(to), m = about == null ? (a + b) / 2 : to(about);
    const low = Math.max(first, m - (m - a) * factor), high = Math.min(last, m + (b - m) * factor);
    zoom(chart, back(low), back(high));
  }

  function pan(chart, part) {
    const { min, max } = own(chart).scales.x;
    const to = chart.logarithmic ? Math.log : v => v, back = chart.logarithmic ? Math.exp : v => v;
    const [a, b, first, last] = [min, max, ...chart.x_limits].map(to);
    const by = Math.max(first - a, Math.min(last - b, part * (b - a)));
    zoom(chart, back(a + by), back(b + by));
  }

  // The cursor of every figure of a group at one place.
  function point(group, value) {
    for (const u of groups.get(group) ?? []) {
      u.setCursor({ left: u.valToPos(value, "x"), top: 5 }, true, false);
    }
  }

  function keys(chart, box, spoken) {
    let at = null;
    box.addEventListener("keydown", event => {
      const u = own(chart), { min, max } = u.scales.x;
      if (event.ctrlKey || event.metaKey || event.altKey || event.target !== box) return;
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (step && event.shiftKey) pan(chart, 0.2 * step);
      else if (step) {
        const k = u.valToPos(at ?? u.posToVal(u.over.clientWidth / 2, "x"), "x") + step * 4;
        at = Math.min(max, Math.max(min, u.posToVal(k, "x")));
        point(chart.group, at);
        const legends = [...box.querySelectorAll(".u-series:not(.unlisted)")];
        spoken.textContent = legends.map(l => l.textContent.trim()).join("; ");
      } else if (event.key === "+" || event.key === "=") closer(chart, 0.5, at);
      else if (event.key === "-") closer(chart, 2, at);
      else if (event.key === "0" || event.key === "Escape") reset(chart);
      else return;
      event.preventDefault();
    });
  }

  function tools(chart, box) {
    const bar = document.createElement("div");
    bar.className = "tools";
    for (const [words, label, act] of [["+", "Zoom in", () => closer(chart, 0.5)], ["−", "Zoom out", () => closer(chart, 2)],
      ["◂", "Earlier", () => pan(chart, -0.5)], ["▸", "Later", () => pan(chart, 0.5)], ["All", "Show all", () => reset(chart)]]) {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = words;
      button.title = label;
      button.setAttribute("aria-label", `${label}: ${chart.title}`);
      button.addEventListener("click", act);
      bar.append(button);
    }
    const hint = document.createElement("span");
    hint.textContent = "drag to zoom, double click for all; keys ← → + − 0";
    bar.append(hint);
    box.append(bar);
  }

  function build(figure) {
    const chart = numbers.charts[+figure.dataset.chart];
    // Figures over the same quantity move together; over time those of one flight.
    chart.group = (chart.x_label || "x") + (chart.of ? `, ${chart.of}` : "");
    const box = figure.querySelector(".live");
    const title = document.createElement("h4");
    title.textContent = chart.title;
    const spoken = document.createElement("p");
    spoken.className = "unseen";
    spoken.setAttribute("role", "status");
    box.append(title);
    if (chart.note) {
      const note = document.createElement("p");
      note.className = "y";
      note.textContent = chart.note;
      box.append(note);
    }
    tools(chart, box);
    figure.classList.add("drawn");
    if (!groups.has(chart.group)) groups.set(chart.group, []);
    chart.panels.forEach((panel, k) => {
      const place = document.createElement("div");
      place.className = "panel";
      const label = document.createElement("p");
      label.className = "y";
      label.textContent = panel.label;
      place.append(label);
      box.append(place);
      if (panel.series.length) groups.get(chart.group).push(plot(chart, panel, place, k === chart.panels.length - 1));
    });
    box.append(spoken);
    keys(chart, box, spoken);
  }

  for (const figure of document.querySelectorAll("figure[data-chart]")) build(figure);
  const all = () => [...groups.values()].flat();
  night.addEventListener("change", () => all().forEach(u => u.redraw(true, true)));
  // Where a figure is folded away its place has no width.
  const fit = width => all().forEach(u => {
    const place = width ?? u.root.parentElement.clientWidth;
    if (place) u.setSize({ width: Math.max(260, place), height: u.height });
  });
  let seen = 0;
  new ResizeObserver(() => {
    if (document.body.clientWidth === seen) return;
    seen = document.body.clientWidth;
    fit();
  }).observe(document.body);
  // On paper: dark on white, whole, and no wider than a sheet.
  const print = on => {
    document.documentElement.classList.toggle("printing", on);
    fit(on ? 660 : undefined);
    all().forEach(u => u.redraw(true, true));
  };
  addEventListener("beforeprint", () => print(true));
  addEventListener("afterprint", () => print(false));
  window.heliCharts = { groups };
})();
