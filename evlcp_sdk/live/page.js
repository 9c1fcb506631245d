"use strict";
const by = (id) => document.getElementById(id);
const KEEP_S = 60, BIN_S = 0.1, MAX_ROWS = 12, MAX_MESSAGES = 50, MAX_FIXES = 2000, MAX_ZOOMS = 4;
let about = null, run = null, socket = null, wait = 250;
// All that is shown; `shown` is what a test, or a curious reader, may look at.
const shown = { pictures: 0, frames: 0, fixes: 0, connects: 0, dropped: 0, last: [] };
window.shown = shown;
let zero = null, bins = new Map(), rates = [], rows = [], messages = [], status = null, ended = null;
let fixes = [], track = [], sites = [], refused = null, record = null, dirty = false, counted = [];
const distances = new Map();

// No number is "-0.00".
const fixed = (value, n) => value.toFixed(n).replace(/^-(?=[0.]+$)/, "");
const ms = (us) => fixed(us / 1e3, 1);
const make = (tag, ...inside) => { const made = document.createElement(tag); made.append(...inside); return made; };
const meters = (news, n) => (news && news.ranged ? fixed(news.ranged.distance_m, n) : "-");
const colour = (bar) => about.colours[bar % about.colours.length];
const digits = (value, n) => (value === null || value === undefined ? "-" : fixed(value, n));
const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// What comes

function clearResults() {
  zero = null; bins = new Map(); rates = []; rows = []; messages = []; status = null; ended = null;
  fixes = []; track = []; sites = []; refused = null; counted = []; distances.clear();
  shown.pictures = shown.frames = shown.fixes = 0; shown.last = [];
}

function takeNews(news) {
  dirty = true;
  if (news.t_us !== undefined && news.line !== "message") zero = zero === null ? news.t_us : zero;
  if (news.line === "frame") {
    shown.frames++;
    shown.last.push(news);
    if (shown.last.length > 400) shown.last.splice(0, 200);
    rows.push(news);
    if (rows.length > MAX_ROWS) rows.shift();
    const before = distances.get(news.transmitter);
    // Frames without a pilot have no distance: the last one is still shown.
    const ranged = news.distance_m !== null ? news : before ? before.ranged : null;
    distances.set(news.transmitter, { ...news, ranged });
    if (distances.size > 64) distances.delete(distances.keys().next().value);
    const n = Math.floor((news.t_us - zero) / 1e6 / BIN_S);
    if (!bins.has(n)) bins.set(n, { bars: new Map(), late: 0, latest: null });
    const bin = bins.get(n);
    if (!bin.bars.has(news.transmitter)) bin.bars.set(news.transmitter, [0, 0, 0, 0]);
    const sums = bin.bars.get(news.transmitter);
    if (news.distance_m !== null) { sums[0] += news.distance_m; sums[1]++; }
    sums[2] += news.quality; sums[3]++;
    if (news.late_ms !== null) bin.late = Math.max(bin.late, news.late_ms);
  } else if (news.line === "message") {
    messages.unshift(news);
    messages.length = Math.min(messages.length, MAX_MESSAGES);
  } else if (news.line === "fix") {
    shown.fixes++;
    if (news.enu_m === undefined) { refused = news; return; }
    refused = null;
    fixes.push(news);
    if (fixes.length > MAX_FIXES) fixes.shift();
  } else if (news.line === "bars") {
    sites = news.bars;
  } else if (news.line === "status") {
    // The camera's clock has restarted: times go on from there.
    if (status && news.t_us < status.t_us) { zero = news.t_us; bins = new Map(); rates = []; }
    status = news;
    rates.push([(news.t_us - zero) / 1e6, news.events_per_s / 1e6]);
    counted.push([news.elapsed_s, shown.frames]);
    if (counted.length > 10) counted.shift();
    const from = (news.t_us - zero) / 1e6 - KEEP_S;
    while (rates.length && rates[0][0] < from) rates.shift();
    for (const n of bins.keys()) { if (n * BIN_S < from) bins.delete(n); else break; }
  } else if (news.line === "end") {
    ended = news;
  }
}

// The image, and each bar close by

const image = by("image").querySelector("canvas"), caption = by("image").querySelector("figcaption");
const zooms = new Map();
let bitmap = null, picture = null, bars = [];

function drawDots(pen, bar, scale, left, top) {
  bar.points.forEach((point, k) => {
    if (point === null) return;
    const x = (point[0] + 0.5 - left) * scale, y = (point[1] + 0.5 - top) * scale;
    pen.beginPath();
    pen.arc(x, y, Math.max(2, Math.min(6, scale * 0.7)), 0, 7);
    // Whose pilot is seen there; hollow where its symbol is not given.
    pen.strokeStyle = pen.fillStyle = about.links[bar.link].cluster_colours[k];
    pen.lineWidth = 1.5;
    if (bar.symbols[k] >= 0) pen.fill(); else pen.stroke();
  });
}

function fitCanvas(canvas, ratio) {
  const wide = canvas.clientWidth, dpr = window.devicePixelRatio || 1;
  const w = Math.round(wide * dpr), h = Math.round(wide * ratio * dpr);
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w; canvas.height = h;
    canvas.style.aspectRatio = `1 / ${ratio}`;
  }
  return [canvas.getContext("2d"), w];
}

function drawImage() {
  if (bitmap === null || !about) return;
  const [pen, wide] = fitCanvas(image, bitmap.height / bitmap.width);
  const scale = wide / bitmap.width, dpr = window.devicePixelRatio || 1;
  pen.imageSmoothingEnabled = scale < 1;
  pen.drawImage(bitmap, 0, 0, bitmap.width * scale, bitmap.height * scale);
  pen.lineWidth = dpr;
  pen.strokeStyle = "rgb(190 190 190)";
  for (const [, x, y, w, h] of picture.regions) {
    pen.strokeRect((x - w / 2 - 2) * scale, (y - h / 2 - 2) * scale, (w + 4) * scale, (h + 4) * scale);
  }
  pen.font = `${12 * dpr}px system-ui, sans-serif`;
  for (const bar of bars) {
    drawDots(pen, bar, scale, 0, 0);
    pen.fillStyle = "#fff";
    const news = distances.get(bar.transmitter), far = meters(news, 1);
    const text = bar.echo_of === null ? `${bar.transmitter}: ${far} m` : `reflection of ${bar.echo_of}`;
    const at = Math.min((bar.x_px + 12) * scale, wide - pen.measureText(text).width - 4 * dpr);
    pen.fillText(text, at, bar.y_px * scale);
  }
  caption.textContent = `events of ${picture.window_us / 1e3} ms at ${fixed(picture.t_us / 1e6, 3)} s; `
    + "yellow: brighter, blue: darker; boxes: regions";
  drawZooms();
}

function drawZooms() {
  const near = bars.filter((bar) => bar.echo_of === null).sort((a, b) => a.transmitter - b.transmitter)
    .slice(0, MAX_ZOOMS);
  for (const [number, figure] of zooms) {
    if (!near.some((bar) => bar.transmitter === number)) { figure.remove(); zooms.delete(number); }
  }
  for (const bar of near) {
    if (!zooms.has(bar.transmitter)) {
      const figure = make("figure", make("canvas"), make("figcaption"));
      by("zooms").append(figure);
      zooms.set(bar.transmitter, figure);
    }
    const figure = zooms.get(bar.transmitter), news = distances.get(bar.transmitter);
    const region = picture.regions.find(([, x, y, w, h]) =>
      Math.abs(x - bar.x_px) < w / 2 + 4 && Math.abs(y - bar.y_px) < h / 2 + 4);
    let high = region ? Math.max(region[3], region[4]) : 0;
    for (const point of bar.points) if (point) high = Math.max(high, 2 * Math.abs(point[1] - bar.y_px));
    high = Math.max(16, high * 1.25);
    const wide = high * 0.75, left = bar.x_px - wide / 2, top = bar.y_px - high / 2;
    const [pen, w] = fitCanvas(figure.firstChild, high / wide);
    const scale = w / wide;
    pen.imageSmoothingEnabled = false;
    pen.fillStyle = "rgb(16 16 20)";
    pen.fillRect(0, 0, w, w * high / wide);
    pen.drawImage(bitmap, left, top, wide, high, 0, 0, w, w * high / wide);
    drawDots(pen, bar, scale, left, top);
    figure.lastChild.textContent = `bar ${bar.transmitter}` + (news ? `: ${meters(news, 2)} m, quality ${fixed(news.quality, 2)}` : "");
  }
}

// Charts

const charts = {};
function chart(id, series, data, range) {
  const wide = by(id).clientWidth;
  if (!wide) return;
  const key = series.map((one) => one.label).join() + style("--ink");
  if (charts[id] && charts[id].key !== key) { charts[id].plot.destroy(); delete charts[id]; }
  if (!charts[id]) {
    const axis = { stroke: style("--dim"), grid: { stroke: style("--line") }, ticks: { stroke: style("--line") } };
    charts[id] = { key, plot: new uPlot({
      width: wide, height: 170, cursor: { y: false },
      scales: { x: { time: false }, y: { range } },
      axes: [{ ...axis, size: 32 }, { ...axis, size: 52 }],
      series: [{ label: "s", value: (_, v) => (v === null ? "" : fixed(v, 1)) }, ...series],
    }, data, by(id)) };
    return;
  }
  if (charts[id].plot.width !== wide) charts[id].plot.setSize({ width: wide, height: 170 });
  charts[id].plot.setData(data);
}

function line(label, stroke, n) {
  return { label, stroke, width: 1.5, spanGaps: false, points: { show: false },
    value: (_, v) => (v === null || v === undefined ? "" : fixed(v, n)) };
}

function span(least) {
  return (_, low, high) => {
    if (low === null) return [0, 1];
    const middle = (low + high) / 2, half = Math.max((high - low) * 0.55, least / 2);
    return [middle - half, middle + half];
  };
}

function drawCharts() {
  const numbers = [...bins.keys()], seen = new Set();
  for (const bin of bins.values()) for (const bar of bin.bars.keys()) seen.add(bar);
  const each = [...seen].sort((a, b) => a - b).slice(-6), x = numbers.map((n) => (n + 0.5) * BIN_S);
  const of = (value) => each.map((bar) => numbers.map((n) => {
    const sums = bins.get(n).bars.get(bar);
    return sums === undefined ? null : value(sums);
  }));
  if (x.length) {
    chart("distance", each.map((bar) => line(`bar ${bar}`, colour(bar), 2)),
      [x, ...of((s) => (s[1] ? s[0] / s[1] : null))], span(1));
    chart("quality", each.map((bar) => line(`bar ${bar}`, colour(bar), 2)), [x, ...of((s) => s[2] / s[3])],
      () => [0, 1.05]);
    chart("delay", [line("longest of 0.1 s", colour(0), 2)], [x, numbers.map((n) => bins.get(n).late)],
      (_, low, high) => [0, Math.max(1, (high || 0) * 1.1)]);
  }
  if (rates.length) {
    chart("rate", [line("million/s", colour(0), 2)], [rates.map((r) => r[0]), rates.map((r) => r[1])],
      (_, low, high) => [0, Math.max(0.1, (high || 0) * 1.1)]);
  }
}

// The map, in local metres

function drawMap() {
  by("place").hidden = !(fixes.length || refused || about.sites);
  if (by("place").hidden) return;
  const last = fixes[fixes.length - 1];
  let text = "no position yet";
  if (last) {
    text = `${fixed(last.latitude_deg, 7)}, ${fixed(last.longitude_deg, 7)} deg, ${fixed(last.height_m, 2)} m`
      + ` (± ${last.sigma_m.map((v) => digits(v, 2)).join(", ")} m E, N, U), ${fixed(last.t_us / 1e6, 2)} s`
      + (last.speed_m_s === null ? "" : `, ${fixed(last.speed_m_s, 1)} m/s`)
      + (last.verified ? ", verified" : "") + (last.alarms.length ? `; ${last.alarms.join(", ")}` : "");
  }
  if (refused) text += `; refused now: ${refused.refusal} ${refused.detail}`;
  by("fix").textContent = text;
  const map = by("map"), dpr = window.devicePixelRatio || 1;
  const ratio = map.clientWidth < 500 ? 0.9 : 0.42;
  const [pen, wide] = fitCanvas(map, ratio), high = map.height;
  pen.clearRect(0, 0, wide, high);
  const places = [...fixes.map((fix) => fix.track_m), ...sites.map((site) => site.slice(1))];
  if (!places.length) return;
  const low = [0, 1].map((i) => Math.min(...places.map((p) => p[i])));
  const top = [0, 1].map((i) => Math.max(...places.map((p) => p[i])));
  const margin = 30 * dpr;
  const scale = Math.min((wide - 2 * margin) / Math.max(top[0] - low[0], 2), (high - 2 * margin) / Math.max(top[1] - low[1], 2));
  const at = (p) => [wide / 2 + (p[0] - (low[0] + top[0]) / 2) * scale, high / 2 - (p[1] - (low[1] + top[1]) / 2) * scale];
  const ink = style("--ink"), dim = style("--dim"), rule = style("--line");
  pen.font = `${12 * dpr}px system-ui, sans-serif`;
  // A scale of a round number of metres.
  const steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000];
  const step = steps.find((s) => s * scale > 60 * dpr) || 10000;
  pen.strokeStyle = rule; pen.lineWidth = dpr; pen.beginPath();
  const from = [low[0], low[1]].map((v, i) => Math.floor((v - (i ? high : wide) / scale) / step) * step);
  for (let e = from[0]; e * scale < (top[0] * scale + wide); e += step) {
    const [px] = at([e, 0]); pen.moveTo(px, 0); pen.lineTo(px, high);
  }
  for (let n = from[1]; n * scale < (top[1] * scale + high); n += step) {
    const [, py] = at([0, n]); pen.moveTo(0, py); pen.lineTo(wide, py);
  }
  pen.stroke();
  pen.fillStyle = dim;
  pen.fillText(`a square: ${step} m; north is up`, 8 * dpr, high - 8 * dpr);
  pen.strokeStyle = colour(0); pen.lineWidth = 2 * dpr; pen.beginPath();
  fixes.forEach((fix, i) => {
    const [px, py] = at(fix.track_m);
    if (i === 0 || fix.starts) pen.moveTo(px, py); else pen.lineTo(px, py);
  });
  pen.stroke();
  if (last) {
    // 95 % of the newest fix, at least a dot.
    const [a, b, , d] = last.covariance_m2, mean = (a + d) / 2, turn = Math.hypot((a - d) / 2, b);
    const [px, py] = at(last.enu_m);
    pen.strokeStyle = pen.fillStyle = colour(1);
    pen.beginPath();
    pen.ellipse(px, py, Math.max(3 * dpr, 2.448 * scale * Math.sqrt(mean + turn)),
      Math.max(3 * dpr, 2.448 * scale * Math.sqrt(Math.max(mean - turn, 0))), -0.5 * Math.atan2(2 * b, a - d), 0, 7);
    pen.stroke();
    pen.beginPath(); pen.arc(px, py, 3 * dpr, 0, 7); pen.fill();
  }
  pen.fillStyle = ink;
  for (const [id, ...place] of sites) {
    const [px, py] = at(place);
    pen.fillRect(px - 4 * dpr, py - 4 * dpr, 8 * dpr, 8 * dpr);
    pen.fillText(`id ${id}`, px + 7 * dpr, py + 4 * dpr);
  }
}

// Words and numbers

function tile(label, value, unit, note) {
  const number = make("b", value, ...(unit ? [make("small", ` ${unit}`)] : []));
  const div = make("div", make("span", label), number, ...(note ? [make("small", note)] : []));
  div.className = "tile";
  return div;
}

function fillTable(id, rows) {
  by(id).replaceChildren(...rows.map((cells) => make("tr", ...cells.map((one) => make("td", one)))));
}

function symbols(news) {
  const most = Math.max(about.links[news.link || ""].symbols - 1, 1), all = document.createDocumentFragment();
  for (const symbol of news.symbols) {
    const i = make("i", symbol === null ? "-" : symbol);
    if (symbol === null) i.className = "none"; else i.style.setProperty("--hue", Math.round(300 * symbol / most));
    all.append(i, " ");
  }
  return all;
}

function drawWords() {
  const tiles = [];
  if (status) {
    const total = status.recent.total, all = status.delays.total;
    const first = counted[0], over = counted[counted.length - 1];
    const rate = over[0] > first[0] ? (over[1] - first[1]) / (over[0] - first[0]) : 0;
    tiles.push(tile("camera clock", fixed(status.t_us / 1e6, 1), "s"),
      tile("events", fixed(status.events_per_s / 1e6, 2), "million/s"),
      tile("frames", fixed(rate, 0), "/s"),
      tile("delay, now", digits(total.p50_ms, 1), "ms", `99 %: ${digits(total.p99_ms, 1)} ms`),
      tile("delay, all", digits(all.p50_ms, 1), "ms", `99 %: ${digits(all.p99_ms, 1)}, max ${digits(all.max_ms, 1)} ms`));
    const whole = status.delays.end_to_end;
    if (whole.count) {
      tiles.push(tile("end to end", digits(whole.p50_ms, 1), "ms", `${whole.count} times; max ${digits(whole.max_ms, 1)} ms`));
    }
  }
  const newest = rows.length ? rows[rows.length - 1].t_us : 0;
  const near = [...distances].filter(([, news]) => news.echo_of === null && Math.abs(news.t_us - newest) < 1e6);
  for (const [bar, news] of near.sort((a, b) => a[0] - b[0]).slice(-6)) {
    const sigma = news.ranged ? digits(news.ranged.distance_sigma_m, 2) : "-";
    tiles.push(tile(news.link ? `bar ${bar}, ${news.link}` : `bar ${bar}`, meters(news, 2), "m", `± ${sigma} m, quality ${fixed(news.quality, 2)}`));
  }
  by("tiles").replaceChildren(...tiles);

  const alarms = [];
  if (status && status.level) {
    alarms.push(`The receiver cannot keep up: ${about.levels.slice(1, status.level + 1).join(", ")}.`);
  }
  if (record && record.fault) alarms.push(`The recording ended: ${record.fault}`);
  if (ended) alarms.push(`The run has ended, ${ended.status}: ${ended.error || ended.result}.`);
  by("alarm").textContent = alarms.join(" ");
  by("alarm").hidden = !alarms.length;

  fillTable("frames", [...rows].reverse().map((news) => [ms(news.t_us), news.transmitter, news.packet, news.frame,
    digits(news.distance_m, 2), fixed(news.quality, 2), symbols(news)]));

  fillTable("messages", messages.map((one) =>
    [fixed(one.t_us / 1e6, 2), one.transmitter, one.transmitter_id, one.kind, one.trust, one.said]));
  by("silent").hidden = messages.length > 0;

  const lost = [];
  if (status) {
    for (const [name, n] of Object.entries(status.shed)) if (n) lost.push([`left out: ${name}`, n]);
    for (const [name, one] of Object.entries(status.losses)) if (one.count) lost.push([`source: ${name}`, one.count]);
    for (const [name, n] of Object.entries(status.counts)) {
      if (n && (name.startsWith("dropped") || name.includes("rejected"))) lost.push([`receiver: ${name}`, n]);
    }
  }
  if (shown.dropped) lost.push(["results this browser was too slow for", shown.dropped]);
  if (record && record.dropped) lost.push(["pieces the recording was too slow for", record.dropped]);
  fillTable("lost", lost.map(([name, n]) => [name.replaceAll("_", " "), n.toLocaleString("en")]));
  by("whole").hidden = lost.length > 0;

  const button = by("record");
  button.hidden = !about.may_record || !!ended;
  if (record) {
    button.className = record.recording ? "on" : "";
    button.textContent = record.recording ? `Stop recording (${fixed(record.events / 1e6, 1)} M events)` : "Record";
    button.title = record.file || "";
  }
}

by("record").addEventListener("click", () => {
  if (socket && socket.readyState === 1) socket.send(JSON.stringify({ record: !(record && record.recording) }));
});

setInterval(() => {
  if (!dirty || !about || document.hidden) return;
  dirty = false;
  drawWords();
  drawCharts();
  drawMap();
}, 200);
addEventListener("resize", () => { dirty = true; drawImage(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { dirty = true; });

// The connection

function showState(text, on) {
  by("state").textContent = text;
  by("state").className = on ? "on" : "";
}

async function receiveBundle(data) {
  const size = new DataView(data).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, size)));
  head.news.forEach(takeNews);
  shown.dropped = head.dropped;
  if (JSON.stringify(head.record) !== JSON.stringify(record)) { record = head.record; dirty = true; }
  if (head.picture) {
    const next = await createImageBitmap(new Blob([new Uint8Array(data, 4 + size)], { type: "image/png" }));
    if (bitmap) bitmap.close();
    bitmap = next; picture = head.picture; bars = head.bars;
    shown.pictures++;
    drawImage();
  }
}

function connect() {
  const mine = new WebSocket(`${location.origin.replace("http", "ws")}${location.pathname}live`);
  mine.binaryType = "arraybuffer";
  socket = mine;
  mine.onmessage = async (event) => {
    if (typeof event.data === "string") {
      about = JSON.parse(event.data).about;
      // The same run sends what is kept of it again.
      if (run === about.run) { messages = []; fixes = []; } else clearResults();
      run = about.run;
      shown.connects++;
      wait = 250;
      showState("live", true);
    } else {
      await receiveBundle(event.data);
    }
    // A credit: what came is shown.
    if (mine.readyState === 1) mine.send('{"next": true}');
  };
  mine.onclose = () => {
    showState(ended ? "ended" : "connection lost, trying again", false);
    dirty = true;
    if (!ended) setTimeout(connect, wait);
    wait = Math.min(2 * wait, 4000);
  };
}
connect();
