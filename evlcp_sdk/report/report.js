"use strict";
const held = JSON.parse(document.getElementById("report").textContent);

// The bar in slow motion: its events, its clusters, and what each of them sends.
const motion = document.getElementById("motion");
if (motion) {
  const canvas = motion.querySelector("canvas"), pen = canvas.getContext("2d");
  const slider = motion.querySelector("input"), button = motion.querySelector("button");
  const choice = motion.querySelector("select"), text = motion.querySelector("output");
  const DARK = [16, 16, 20], ON = [255, 205, 70], OFF = [70, 150, 255];
  const GAP = 14, HEAD = 18, NUMBERS = 26, NARROWEST = 50;
  let shown = null, timer = null;
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  const mixed = (a, b, share) => a.map((v, i) => v + (b[i] - v) * share);
  const image = (colour) => {
    const small = document.createElement("canvas");
    small.width = shown.width; small.height = shown.height;
    const its = small.getContext("2d"), pixels = its.createImageData(shown.width, shown.height);
    for (let i = 0; i < shown.width * shown.height; i++) {
      const [r, g, b] = colour(i);
      pixels.data.set([r, g, b, 255], 4 * i);
    }
    its.putImageData(pixels, 0, 0);
    return small;
  };
  const draw = () => {
    const chip = Number(slider.value), wide = motion.clientWidth, cells = shown.width * shown.height;
    const clusters = shown.lit.length, style = getComputedStyle(motion);
    const ink = style.getPropertyValue("--ink"), dim = style.getPropertyValue("--dim");
    const panel = style.getPropertyValue("--line"), colours = shown.colours.map(rgb);
    // Beside one another where there is room for it, one below the other where not.
    let scale = Math.min(8, 460 / shown.height);
    const stacked = 2 * (shown.width * scale + GAP) + 180 > wide;
    if (stacked) scale = Math.min(8, 300 / shown.height, (wide - GAP) / 2 / shown.width);
    // A bar is far narrower than high: it is drawn wider where it would be a line.
    const w = Math.max(shown.width * scale, NARROWEST), h = shown.height * scale;
    const left = stacked ? 0 : 2 * (w + GAP), top = stacked ? h + 2 * HEAD + GAP : HEAD;
    const rasterWide = Math.min(wide - left - NUMBERS, 22 * shown.chips);
    const rasterHigh = stacked ? Math.min(14 * clusters, 400) : h;
    const high = top + rasterHigh + 4;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(wide * ratio); canvas.height = Math.round(high * ratio);
    canvas.style.height = `${high}px`;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.imageSmoothingEnabled = false;
    pen.font = "12px system-ui, sans-serif";
    pen.textBaseline = "middle";
    const events = image((i) => {
      const n = shown.events.charCodeAt(chip * cells + i) - 101;
      return n === 0 ? DARK : mixed(DARK, n > 0 ? ON : OFF, Math.min(1, 0.4 + 0.2 * Math.abs(n)));
    });
    const light = image((i) => {
      const k = shown.clusters[i];
      if (k < 0) return DARK;
      const lit = shown.lit[k][chip];
      return mixed(DARK, lit === "?" ? [128, 128, 128] : colours[k], lit === "1" ? 1 : 0.22);
    });
    pen.fillStyle = dim;
    pen.fillText("events", 0, HEAD / 2);
    pen.fillText("clusters", w + GAP, HEAD / 2);
    pen.drawImage(events, 0, HEAD, w, h);
    pen.drawImage(light, w + GAP, HEAD, w, h);
    const cell = rasterWide / shown.chips, row = rasterHigh / clusters;
    pen.fillText("pilot", left, top - HEAD / 2);
    pen.fillText("symbol", left + shown.pilot * cell + 2, top - HEAD / 2);
    for (let k = 0; k < clusters; k++) {
      const y = top + (shown.upside ? clusters - 1 - k : k) * row;
      for (let c = 0; c < shown.chips; c++) {
        pen.globalAlpha = c > chip ? 0.35 : 1;
        const lit = shown.lit[k][c];
        pen.fillStyle = lit === "1" ? shown.colours[k] : lit === "?" ? dim : panel;
        // What is not known is a dash.
        const thick = lit === "?" ? 1 : Math.max(row - 2, 1);
        pen.fillRect(left + c * cell, y + (row - thick) / 2, Math.max(cell - 1, 1), thick);
      }
      pen.globalAlpha = 1;
      if (row >= 9) {
        pen.fillStyle = ink;
        const symbol = shown.symbols[k];
        pen.fillText(symbol === null ? "-" : String(symbol), left + rasterWide + 5, y + row / 2);
      }
    }
    pen.strokeStyle = ink;
    pen.lineWidth = 1.5;
    pen.strokeRect(left + chip * cell - 0.5, top, cell, rasterHigh);
    pen.fillStyle = dim;
    pen.fillRect(left + shown.pilot * cell - 1, top, 1, rasterHigh);
    const part = chip < shown.pilot ? "pilot" : "symbol";
    const ms = (shown.start_ms + chip * shown.chip_ms).toFixed(2);
    text.textContent = `${shown.name}: chip ${chip + 1} of ${shown.chips}, ${part}, ${ms} ms`;
  };
  const stop = () => { clearInterval(timer); timer = null; button.textContent = "Play"; };
  const play = () => {
    timer = setInterval(() => { slider.value = (Number(slider.value) + 1) % shown.chips; draw(); }, 150);
    button.textContent = "Pause";
  };
  const choose = () => {
    shown = held.motions[choice.value];
    slider.max = shown.chips - 1;
    slider.value = shown.pilot + 4;
    draw();
  };
  slider.addEventListener("input", () => { stop(); draw(); });
  button.addEventListener("click", () => { if (timer === null) play(); else stop(); });
  choice.addEventListener("change", choose);
  window.addEventListener("resize", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  choose();
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) play();
}
