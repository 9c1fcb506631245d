"use strict";
// Charts: the value nearest to the pointer, and lines that are shown or hidden by their names.
const plots = JSON.parse(document.getElementById("plots").textContent);
for (const [id, labels] of Object.entries(plots)) {
  const plot = document.getElementById(id), area = plot.querySelector(".area"), hidden = new Set();
  const tip = document.createElement("div"), marker = document.createElement("div");
  tip.className = "tip"; marker.className = "at";
  tip.hidden = marker.hidden = true;
  area.append(marker, tip);
  const hide = () => { tip.hidden = marker.hidden = true; };
  const show = (event) => {
    const box = area.getBoundingClientRect();
    const x = event.clientX - box.left, y = event.clientY - box.top;
    let best = null, least = 40 * 40;
    for (const label of labels) {
      const dx = label[0] / 1000 * box.width - x, dy = label[1] / 1000 * box.height - y;
      const distance = dx * dx + dy * dy;
      if (distance < least && !hidden.has(label[3])) { least = distance; best = label; }
    }
    if (best === null) { hide(); return; }
    const left = `${best[0] / 10}%`, top = best[1] / 1000 * box.height;
    tip.textContent = best[2];
    tip.hidden = marker.hidden = false;
    marker.style.left = left; marker.style.top = `${best[1] / 10}%`;
    // By shares: both stay within the chart when the page becomes narrower under a pointer that rests.
    tip.style.left = `max(0px, min(${left} + 12px, 100% - ${tip.offsetWidth}px))`;
    tip.style.top = `${top > tip.offsetHeight + 12 ? top - tip.offsetHeight - 10 : top + 12}px`;
  };
  area.addEventListener("pointermove", show);
  area.addEventListener("pointerdown", show);
  area.addEventListener("pointerleave", hide);
  for (const button of plot.querySelectorAll(".legend button")) button.addEventListener("click", () => {
    const line = Number(button.dataset.line), shown = hidden.delete(line);
    if (!shown) hidden.add(line);
    button.setAttribute("aria-pressed", shown);
    for (const path of plot.querySelectorAll(`[data-line="${line}"]:not(button)`)) {
      path.style.display = shown ? "" : "none";
    }
  });
}
