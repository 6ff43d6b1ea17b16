"use strict";
// Draws the curves that `page.curves` packed: means of all runs, and single runs on demand.

(async () => {
  const told = JSON.parse(document.getElementById("told").textContent);
  const section = document.getElementById("curves");
  if (!told.measures) return section.remove();
  const bytes = Uint8Array.from(atob(told.packed), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const steps = new Int16Array(await new Response(stream).arrayBuffer());
  let read = 0;
  const line = (points) => {
    let height = 0;
    return Array.from({ length: points }, () => (height += steps[read++]));
  };
  for (const measure of told.measures)
    measure.lines = measure.arms.map(([arm, points, runs]) => {
      const [mean, low, high] = [line(points), line(points), line(points)];
      return { arm, mean, low, high, runs: Array.from({ length: runs }, () => line(points)) };
    });

  const arms = new Set(told.arms.slice(0, 8).keys());
  const runs = new Set();
  let measure = told.measures[0];
  let at = told.episodes.length - 1;
  let pointed = NaN;

  const make = (kind, inside, more = {}) => Object.assign(inside.appendChild(
    document.createElement(kind)), more);
  const toggle = (inside, set, item, name) => {
    const label = make("label", inside);
    const box = make("input", label, { type: "checkbox", checked: set.has(item) });
    box.onchange = () => { set[box.checked ? "add" : "delete"](item); draw(); };
    make("span", label, { textContent: name });
    return [label, box];
  };
  const ink = ({ color }) => color === "#000000" ? "currentColor" : color;
  const look = (arm) => `fill="none" stroke="${ink(arm)}" stroke-dasharray="${arm.dashes}"`;

  make("h2", section, { textContent: "Curves" });
  const chosen = make("label", section, { textContent: "What: " });
  const select = make("select", chosen);
  told.measures.forEach(({ name }) => make("option", select, { textContent: name }));
  select.onchange = () => { measure = told.measures[select.selectedIndex]; draw(); };
  const chart = make("div", section, { className: "chart" });
  const place = make("label", section, { className: "place" });
  const where = make("span", place);
  const slider = make("input", place, { type: "range", min: 0, max: at, value: at });
  slider.oninput = () => { at = +slider.value; tell(); };
  const nearest = make("p", section, { className: "nearest" });
  const legend = make("div", section, { className: "arms" });
  const values = told.arms.map((arm, number) => {
    const [label] = toggle(legend, arms, number, arm.name);
    const swatch = document.createElement("i");
    label.insertBefore(swatch, label.lastChild);
    swatch.innerHTML = `<svg width="34" height="10" aria-hidden="true"><path d="M1 5H33" ${look(arm)
    } stroke-width="2.5"/></svg>`;
    return make("output", label);
  });
  const most = Math.max(...told.measures.flatMap((one) => one.lines.map((own) => own.runs.length)));
  const seeds = make("details", section, { open: most <= 20 });
  make("summary", seeds, { textContent: `Single runs, by ${told.by}` });
  const boxes = make("div", seeds, { className: "seeds" });
  const all = [...Array(most).keys()];
  for (const [name, kept] of [["all", all], ["none", []]])
    make("button", boxes, { textContent: name, type: "button" }).onclick = () => {
      runs.clear();
      kept.forEach((run) => runs.add(run));
      each.forEach(([, box], run) => { box.checked = runs.has(run); });
      draw();
    };
  const each = all.map((run) => toggle(boxes, runs, run, told.runs[run] ?? run));
  const note = make("p", section, { className: "note" });

  const value = (height) => measure.orders
    ? measure.lowest * (measure.highest / measure.lowest) ** (height / told.heights)
    : measure.lowest + (measure.highest - measure.lowest) * height / told.heights;
  const height = (value) => told.heights * (measure.orders
    ? Math.log(value / measure.lowest) / Math.log(measure.highest / measure.lowest)
    : (value - measure.lowest) / (measure.highest - measure.lowest));
  const said = (height) => height < 0 ? "–" : Number(value(height).toPrecision(4)).toLocaleString(
    "en", { maximumSignificantDigits: 4 });
  function ticks(low, high, most) {
    const rough = (high - low) / most, power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find((one) => one * power >= rough);
    const first = Math.ceil(low / step - 1e-9);
    return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 },
      (_, number) => Number(((first + number) * step).toPrecision(12)));
  }
  function orders(low, high) {
    const first = Math.ceil(Math.log10(low)), count = Math.floor(Math.log10(high)) - first + 1;
    return Array.from({ length: count }, (_, number) => Number(`1e${first + number}`));
  }

  let size = {};
  const last = told.episodes.at(-1);
  const x = (episode) => size.left + (size.right - size.left) * episode / last;
  const y = (height) => size.high - 44 - (size.high - 64) * height / told.heights;
  const path = (heights) => {
    let pen = "M";
    return heights.map((one, number) => {
      if (one < 0) return "";
      const point = `${pen}${x(told.episodes[number]).toFixed(1)} ${y(one).toFixed(1)}`;
      pen = "L";
      return point;
    }).join("");
  };
  const shown = () => measure.lines.filter(({ arm }) => arms.has(arm));
  const single = (own) => own.runs.map((heights, run) => [run, heights]).filter(
    ([run]) => runs.has(run));

  function draw() {
    size = { width: Math.max(chart.clientWidth, 260), left: 52 };
    size.right = size.width - 22;
    size.high = Math.round(Math.min(380, Math.max(260, size.width / 2)));
    const { lowest, highest } = measure;
    const across = ticks(0, last, size.width / 90).map((tick) => `<text x="${x(tick)}" y="${
      size.high - 26}" text-anchor="middle">${tick.toLocaleString("en")}</text>`);
    const up = (measure.orders ? orders(lowest, highest) : ticks(lowest, highest, 6)).map((tick) =>
      `<path class="grid" d="M${size.left} ${y(height(tick))}H${size.right}"/>` +
      `<text x="${size.left - 6}" y="${y(height(tick)) + 4}" text-anchor="end">${
        Math.abs(tick) >= 1e5 || (tick && Math.abs(tick) < 1e-3)
          ? tick.toExponential(0) : tick.toLocaleString("en")}</text>`);
    const edge = (heights, points) => points.map((number) =>
      `${x(told.episodes[number]).toFixed(1)} ${y(heights[number]).toFixed(1)}`);
    const bands = shown().map(({ arm, low, high }) => {
      const points = [...low.keys()].filter((number) => low[number] >= 0 && high[number] >= 0);
      const around = [...edge(high, points), ...edge(low, points.reverse())].join("L");
      return around && `<path d="M${around}Z" fill="${ink(told.arms[arm])}" opacity="0.13"/>`;
    });
    const thin = `stroke-width="1" opacity="${runs.size > 20 ? 0.2 : 0.5}"`;
    const singles = shown().flatMap((own) => single(own).map(([, heights]) =>
      `<path d="${path(heights)}" ${look(told.arms[own.arm])} ${thin}/>`));
    const means = shown().map(({ arm, mean }) => `<path class="halo" d="${path(mean)}"/>` +
      `<path d="${path(mean)}" ${look(told.arms[arm])} stroke-width="2.2"/>`);
    const said = (x, y, words, anchor) =>
      `<text class="said" x="${x}" y="${y}" text-anchor="${anchor}">${words}</text>`;
    const solved = measure.solved === null ? [] : [
      `<path class="solved" d="M${size.left} ${y(height(measure.solved))}H${size.right}"/>`,
      said(size.right, y(height(measure.solved)) - 4, told.rule, "end")];
    const axes = [said(4, 12, measure.name, "start"),
      said(size.right, size.high - 8, "real episodes", "end")];
    const drawn = [...up, ...across, ...bands, ...singles, ...means, ...solved, ...axes].join("");
    chart.innerHTML = `<svg width="${size.width}" height="${size.high}" role="img">${drawn
    }<path class="cursor" id="cursor"/></svg>`;
    const here = Math.max(...measure.lines.map((own) => own.runs.length));
    note.textContent = `Each curve is a running mean of ${told.window} episodes; a run that is ` +
      `over keeps its last value. Thick: the mean of all runs; shaded: ${told.shaded}; thin: ` +
      `single runs${here < told.runs.length ? `, of which the first ${here} are here` : ""}.` +
      (told.more ? ` Of ${told.more} more arms the report has the figures alone.` : "") +
      (told.by === "seed" ? "" : ` Seeds are not the same: runs go by ${told.by}.`);
    chart.firstChild.setAttribute("aria-label", `${measure.name} against real episodes`);
    tell();
  }
  function tell() {
    where.textContent = `Real episode ${told.episodes[at].toLocaleString("en")} `;
    slider.value = at;
    document.getElementById("cursor").setAttribute("d",
      `M${x(told.episodes[at])} 20V${size.high - 44}`);
    values.forEach((output) => { output.textContent = ""; });
    let best = [Infinity];
    for (const own of shown()) {
      if (at >= own.mean.length) continue;
      const ends = own.low[at] < 0 ? "" : ` (${said(own.low[at])} to ${said(own.high[at])})`;
      values[own.arm].textContent = said(own.mean[at]) + ends;
      for (const [run, heights] of single(own)) {
        const far = Math.abs(y(heights[at]) - pointed);
        if (heights[at] >= 0 && far < best[0]) best = [far, own.arm, run, heights[at]];
      }
    }
    const [, arm, run, found] = best;
    nearest.textContent = arm === undefined ? "" :
      `Nearest run: ${told.arms[arm].name}, ${told.by} ${told.runs[run] ?? run}: ${said(found)}`;
  }
  chart.onpointermove = (event) => {
    const box = chart.getBoundingClientRect();
    const episode = last * (event.clientX - box.left - size.left) / (size.right - size.left);
    const far = (number) => Math.abs(told.episodes[number] - episode);
    at = told.episodes.reduce((best, _, number) => far(number) < far(best) ? number : best, 0);
    pointed = event.clientY - box.top;
    tell();
  };
  addEventListener("resize", draw);
  draw();
})();
