(function () {
  "use strict";
  const root = document.documentElement;
  const plots = Array.from(document.querySelectorAll(".plot"));
  const narrow = 520;
  const paper = { full: [680, 0], half: [332, 270], third: [680, 275] };
  const config = {
    displaylogo: false, responsive: true, showSendToCloud: false, plotlyServerURL: "",
    displayModeBar: window.matchMedia("(hover: hover)").matches ? "hover" : false,
    modeBarButtons: [["toImage", "zoom2d", "pan2d", "resetScale2d"]], // nothing that sends data anywhere
  };
  let drawn = 0;
  plots.forEach(function (div) {
    const spec = JSON.parse(document.getElementById(div.id + "-data").textContent);
    if (div.clientWidth < narrow) {
      spec.layout.margin.r = 6;
      spec.data.filter(function (trace) { return trace.type === "heatmap"; }).forEach(function (trace) {
        trace.showscale = false; // the cells hold their numbers
        spec.layout.xaxis.tickfont = { size: 9.5 };
      });
    }
    const image = { format: "svg", filename: div.dataset.name };
    Plotly.newPlot(div, spec.data, spec.layout, Object.assign({ toImageButtonOptions: image }, config))
      .then(function () { div.dataset.height = spec.layout.height; drawn += 1; root.dataset.drawn = drawn; });
  });
  let closed = [];
  window.addEventListener("beforeprint", function () {
    closed = Array.from(document.querySelectorAll("details:not([open])"));
    closed.forEach(function (part) { part.open = true; });
    plots.forEach(function (div) {
      const width = paper[div.dataset.size][0], height = paper[div.dataset.size][1] || Number(div.dataset.height);
      div.style.height = height + "px";
      Plotly.relayout(div, { autosize: false, width: width, height: height });
    });
  });
  window.addEventListener("afterprint", function () {
    closed.forEach(function (part) { part.open = false; });
    plots.forEach(function (div) {
      div.style.height = div.dataset.height + "px";
      Plotly.relayout(div, { autosize: true, width: null, height: Number(div.dataset.height) });
    });
  });
})();
