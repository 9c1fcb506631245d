"use strict";
const data = JSON.parse(document.getElementById("report").textContent);

// The bar in slow motion: context events, context clusters, and what each of them sends.
const motion = document.getElementById("motion");
if (motion) {
  const canvas = motion.querySelector("canvas"), pen = canvas.getContext("2d");
  const slider = motion.querySelector("input"), button = motion.querySelector("button");
  const select = motion.querySelector("select"), text = motion.querySelector("output");
  const DARK = [16, 16, 20], ON = [255, 205, 70], OFF = [70, 150, 255];
  const GAP = 14, HEAD = 18, NUMBERS = 26, NARROWEST = 50;
  let frame = null, timer = null;
  const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
  const mix = (a, b, share) => a.map((v, i) => v + (b[i] - v) * share);
  const image = (colour) => {
    const small = document.createElement("canvas");
    small.width = frame.width; small.height = frame.height;
    const context = small.getContext("2d"), pixels = context.createImageData(frame.width, frame.height);
    for (let i = 0; i < frame.width * frame.height; i++) {
      const [r, g, b] = colour(i);
      pixels.data.set([r, g, b, 255], 4 * i);
    }
    context.putImageData(pixels, 0, 0);
    return small;
  };
  const draw = () => {
    const chip = Number(slider.value), width = motion.clientWidth, cells = frame.width * frame.height;
    const clusters = frame.lit.length, style = getComputedStyle(motion);
    const ink = style.getPropertyValue("--ink"), dim = style.getPropertyValue("--dim");
    const panel = style.getPropertyValue("--line"), colours = frame.colours.map(rgb);
    // Side by side if there is room, else stacked.
    let scale = Math.min(8, 460 / frame.height);
    const stacked = 2 * (frame.width * scale + GAP) + 180 > width;
    if (stacked) scale = Math.min(8, 300 / frame.height, (width - GAP) / 2 / frame.width);
    // A bar is narrow: it is drawn wider where it would be a line.
    const w = Math.max(frame.width * scale, NARROWEST), h = frame.height * scale;
    const left = stacked ? 0 : 2 * (w + GAP), top = stacked ? h + 2 * HEAD + GAP : HEAD;
    const rasterWidth = Math.min(width - left - NUMBERS, 22 * frame.chips);
    const rasterHeight = stacked ? Math.min(14 * clusters, 400) : h;
    const height = top + rasterHeight + 4;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    canvas.style.height = `${height}px`;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.imageSmoothingEnabled = false;
    pen.font = "12px system-ui, sans-serif";
    pen.textBaseline = "middle";
    const events = image((i) => {
      const n = frame.events.charCodeAt(chip * cells + i) - 101;
      return n === 0 ? DARK : mix(DARK, n > 0 ? ON : OFF, Math.min(1, 0.4 + 0.2 * Math.abs(n)));
    });
    const light = image((i) => {
      const k = frame.clusters[i];
      if (k < 0) return DARK;
      const lit = frame.lit[k][chip];
      return mix(DARK, lit === "?" ? [128, 128, 128] : colours[k], lit === "1" ? 1 : 0.22);
    });
    pen.fillStyle = dim;
    pen.fillText("events", 0, HEAD / 2);
    pen.fillText("clusters", w + GAP, HEAD / 2);
    pen.drawImage(events, 0, HEAD, w, h);
    pen.drawImage(light, w + GAP, HEAD, w, h);
    const cell = rasterWidth / frame.chips, row = rasterHeight / clusters;
    pen.fillText("pilot", left, top - HEAD / 2);
    pen.fillText("symbol", left + frame.pilot * cell + 2, top - HEAD / 2);
    for (let k = 0; k < clusters; k++) {
      const y = top + (frame.upside ? clusters - 1 - k : k) * row;
      for (let c = 0; c < frame.chips; c++) {
        pen.globalAlpha = c > chip ? 0.35 : 1;
        const lit = frame.lit[k][c];
        pen.fillStyle = lit === "1" ? frame.colours[k] : lit === "?" ? dim : panel;
        // An unknown chip is a dash.
        const thick = lit === "?" ? 1 : Math.max(row - 2, 1);
        pen.fillRect(left + c * cell, y + (row - thick) / 2, Math.max(cell - 1, 1), thick);
      }
      pen.globalAlpha = 1;
      if (row >= 9) {
        pen.fillStyle = ink;
        const symbol = frame.symbols[k];
        pen.fillText(symbol === null ? "-" : String(symbol), left + rasterWidth + 5, y + row / 2);
      }
    }
    pen.strokeStyle = ink;
    pen.lineWidth = 1.5;
    pen.strokeRect(left + chip * cell - 0.5, top, cell, rasterHeight);
    pen.fillStyle = dim;
    pen.fillRect(left + frame.pilot * cell - 1, top, 1, rasterHeight);
    const part = chip < frame.pilot ? "pilot" : "symbol";
    const ms = (frame.start_ms + chip * frame.chip_ms).toFixed(2);
    text.textContent = `${frame.name}: chip ${chip + 1} of ${frame.chips}, ${part}, ${ms} ms`;
  };
  const stop = () => { clearInterval(timer); timer = null; button.textContent = "Play"; };
  const play = () => {
    timer = setInterval(() => { slider.value = (Number(slider.value) + 1) % frame.chips; draw(); }, 150);
    button.textContent = "Pause";
  };
  const selectFrame = () => {
    frame = data.motions[select.value];
    slider.max = frame.chips - 1;
    slider.value = frame.pilot + 4;
    draw();
  };
  slider.addEventListener("input", () => { stop(); draw(); });
  button.addEventListener("click", () => { if (timer === null) play(); else stop(); });
  select.addEventListener("change", selectFrame);
  window.addEventListener("resize", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  selectFrame();
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) play();
}
