"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const colors = ["#2457c5", "#d1582b", "#11845b", "#8a3fb0", "#b98a00", "#4a5568"];

  // Buttons of one group: the pressed one shows its target and hides those of the others.
  const press = (button) => {
    for (const other of button.parentElement.querySelectorAll("button"))
      other.setAttribute("aria-pressed", String(other === button));
  };

  for (const slider of document.querySelectorAll(".stack input")) {
    const stack = slider.parentElement;
    const move = () => stack.style.setProperty("--cut", slider.value + "%");
    slider.addEventListener("input", move);
    move();
  }

  for (const box of document.querySelectorAll("[data-compare]")) {
    const chosen = { view: null, pair: null };
    const show = () => {
      for (const view of box.querySelectorAll(".view")) {
        view.hidden = view.dataset.view !== chosen.view;
        const figures = [...view.querySelectorAll(".compare")];
        const same = figures.some((figure) => figure.dataset.pair === chosen.pair);
        figures.forEach((figure, number) => {
          figure.hidden = same ? figure.dataset.pair !== chosen.pair : number > 0;
        });
      }
    };
    for (const key of ["view", "pair"]) {
      const buttons = [...box.querySelectorAll("button[data-" + key + "]")];
      for (const button of buttons)
        button.addEventListener("click", () => {
          chosen[key] = button.dataset[key];
          press(button);
          show();
        });
      if (buttons.length) {
        chosen[key] = buttons[0].dataset[key];
        press(buttons[0]);
      }
    }
    show();
  }

  for (const box of document.querySelectorAll("[data-model]")) {
    const viewer = box.querySelector("model-viewer");
    for (const button of box.querySelectorAll("button[data-light]"))
      button.addEventListener("click", () => {
        viewer.environmentImage = button.dataset.light || null;
        press(button);
      });
    const first = box.querySelector("button[data-light]");
    if (first) first.click();
  }

  const joined = (name) => {
    const tables = data.runs.map((run) => [run.step, run[name]]);
    return tables.length > 1 ? uPlot.join(tables) : tables[0];
  };
  const short = (value) => {
    if (value == null) return "–";
    const size = Math.abs(value);
    if (size >= 1e6) return (value / 1e6).toPrecision(3) + " M";
    if (size >= 1e4) return (value / 1e3).toPrecision(3) + " k";
    return String(+value.toPrecision(4));
  };
  // Where a stage begins, a faint line; with several runs there would be too many.
  const stages = (plot) => {
    if (data.runs.length > 1) return;
    const area = plot.bbox, context = plot.ctx;
    context.save();
    context.fillStyle = "#8a92a0";
    context.textAlign = "left";
    context.textBaseline = "alphabetic";
    context.strokeStyle = "#c3c9d2";
    context.font = 11 * devicePixelRatio + "px system-ui, sans-serif";
    for (const stage of data.runs[0].stages) {
      const x = plot.valToPos(stage.step, "x", true);
      context.beginPath();
      context.moveTo(x, area.top);
      context.lineTo(x, area.top + area.height);
      context.stroke();
      context.fillText(stage.name, x + 5 * devicePixelRatio, area.top + 12 * devicePixelRatio);
    }
    context.restore();
  };
  const charts = [];
  for (const place of document.querySelectorAll("[data-curve]")) {
    const name = place.dataset.curve;
    const values = joined(name);
    if (!values[0].length) continue;
    const positive = values.slice(1).every((line) => line.every((v) => v == null || v > 0));
    const axis = { stroke: "#5b6472", grid: { stroke: "#eceef2" }, ticks: { stroke: "#eceef2" } };
    const plot = new uPlot(
      {
        width: place.clientWidth,
        height: 230,
        scales: { x: { time: false }, y: name === "loss" && positive ? { distr: 3 } : {} },
        axes: [
          { ...axis },
          { ...axis, size: 62, values: (_, ticks) => ticks.map((v) => (v == null ? "" : short(v))) },
        ],
        series: [
          { label: "step" },
          ...data.runs.map((run, number) => ({
            label: data.runs.length > 1 ? run.name : place.dataset.label,
            stroke: colors[number % colors.length],
            dash: number >= colors.length ? [6, 4] : undefined,
            width: 1.4,
            spanGaps: true,
            points: { show: false },
            value: (_, v) => short(v),
          })),
        ],
        hooks: { draw: [stages] },
      },
      values,
      place,
    );
    charts.push([plot, place]);
  }
  addEventListener("resize", () => {
    for (const [plot, place] of charts) plot.setSize({ width: place.clientWidth, height: 230 });
  });
})();
