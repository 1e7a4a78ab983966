// The viewer of runs: two linked charts per figure, drawn by uPlot from the figure's own data.
(() => {
  "use strict"
  const INKS = { recorded: "--ink", computed: "--blue", before: "--orange", sent: "--green" }
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim()
  const made = (tag, attributes, ...inner) => {
    const node = document.createElement(tag)
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value)
    node.append(...inner)
    return node
  }
  const line = ({ q, v }) => {
    let at = 0
    return v.map(step => (step === null ? null : (at += step) * q))
  }
  const shown = (value, digits = 2) => (value == null ? "–" : value.toFixed(digits).replace("-", "−"))

  const choice = (label, names, chosen) => {
    const select = made("select", {}, ...names.map(n => made("option", { value: n[0] }, n[1])))
    select.addEventListener("change", chosen)
    return [made("label", {}, made("span", {}, label), select), select]
  }

  const view = (figure, number) => {
    const { panes } = JSON.parse(figure.querySelector("script").textContent)
    const runs = [...new Set(panes.map(p => p.run))]
    const channels = [...new Set(panes.map(p => p.channel))]
    const label = run => {
      const own = panes.filter(p => p.run === run && p.said)
      return own.length === 1 ? `${run}: ${own[0].said}` : run
    }
    const bar = made("div", { class: "choose" })
    const said = made("p", { class: "note", "aria-live": "polite" })
    const charts = made("div", { class: "charts", tabindex: "0", role: "application",
      "aria-label": "Charts of the run; arrow keys move the cursor, plus and minus zoom, 0 shows all" })
    let drawn = []
    let pane = null
    let at = 0 // the sample under the cursor

    const [runLabel, run] = choice("run", runs.map(r => [r, label(r)]), () => draw())
    const [channelLabel, channel] = choice("channel", channels.map(c => [c, c]), () => draw())
    const step = by => {
      run.selectedIndex = (run.selectedIndex + by + runs.length) % runs.length
      draw()
    }
    const before = made("button", { type: "button", "aria-label": "previous run" }, "‹")
    const after = made("button", { type: "button", "aria-label": "next run" }, "›")
    before.addEventListener("click", () => step(-1))
    after.addEventListener("click", () => step(1))
    if (runs.length > 1) bar.append(made("div", { class: "run" }, before, runLabel, after))
    if (channels.length > 1) bar.append(channelLabel)
    figure.querySelector("figcaption").after(bar, charts, said)

    const masked = u => {
      const first = pane.first
      u.ctx.save()
      u.ctx.fillStyle = colour("--line")
      const zero = Math.round(u.valToPos(0, "y", true))
      if (zero > u.bbox.top && zero < u.bbox.top + u.bbox.height) u.ctx.fillRect(u.bbox.left, zero, u.bbox.width, 1)
      u.ctx.fillStyle = colour("--faint")
      for (let i = 0; i < first.length; i++) {
        if (first[i] !== null) continue
        let end = i
        while (end + 1 < first.length && first[end + 1] === null) end++
        const x = at => u.valToPos(pane.time[at], "x", true)
        const [left, right] = [x(Math.max(i - 1, 0)), x(Math.min(end + 1, first.length - 1))]
        u.ctx.fillRect(left, u.bbox.top, Math.max(right - left, 1), u.bbox.height)
        i = end
      }
      u.ctx.restore()
    }

    const summary = () => {
      const { min, max } = drawn[0].scales.x
      const text = pane.below.filter(s => s.difference).map(s => {
        const inside = s.values.filter((v, i) => v !== null && pane.time[i] >= min && pane.time[i] <= max)
        const rms = Math.sqrt(inside.reduce((sum, v) => sum + v * v, 0) / inside.length)
        const most = inside.reduce((top, v) => Math.max(top, Math.abs(v)), 0)
        return inside.length ? `${s.label}: rms ${shown(rms)}, greatest ${shown(most)} ${pane.unit}` : ""
      }).filter(Boolean)
      said.textContent = `${shown(min, 1)} to ${shown(max, 1)} h. ${text.join("; ")}${text.length ? "." : ""}`
    }

    const chart = (series, label, height, last) => new uPlot({
      width: charts.clientWidth || 600, height,
      cursor: { sync: { key: `run-${number}`, scales: ["x", null] }, drag: { x: true, y: false } },
      scales: { x: { time: false } },
      axes: [
        { stroke: colour("--soft"), grid: { stroke: colour("--faint") }, ticks: { stroke: colour("--line") },
          size: last ? 44 : 30, label: last ? "time since start, h" : undefined, labelSize: 16, font: "12px system-ui",
          labelFont: "12px system-ui" },
        { stroke: colour("--soft"), grid: { stroke: colour("--faint") }, ticks: { stroke: colour("--line") },
          size: 58, label, labelSize: 16, font: "12px system-ui", labelFont: "12px system-ui" },
      ],
      series: [
        { label: "time, h", value: (u, v) => shown(v) },
        ...series.map((s, k) => ({ label: s.label, stroke: colour(INKS[s.look]), width: k === 0 && !last ? 1.2 : 1.8,
          value: (u, v) => shown(v), points: { show: false } })),
      ],
      hooks: {
        drawClear: [masked],
        setScale: [(u, key) => { if (key === "x" && u === drawn[0]) summary() }],
      },
    }, [pane.time, ...series.map(s => s.values)], charts)

    const draw = () => {
      const found = panes.find(p => p.run === run.value && p.channel === channel.value) ||
        panes.find(p => p.run === run.value)
      channel.value = found.channel
      const lines = found.lines.map(l => ({ label: l.label, look: l.look, lower: l.lower, values: line(l) }))
      const upper = lines.filter(l => !l.lower)
      const rest = found.residual ? upper.slice(1).map(l => ({
        label: upper.length > 2 ? `${upper[0].label} − ${l.label}` : "residual", difference: true,
        look: upper.length > 2 ? l.look : "before",
        values: l.values.map((v, i) => (v === null || upper[0].values[i] === null ? null : upper[0].values[i] - v)),
      })) : []
      pane = { time: line(found.time), unit: found.unit, first: upper[0].values,
        below: [...rest, ...lines.filter(l => l.lower)] }
      drawn.forEach(u => u.destroy())
      drawn = []
      at = 0
      const unit = found.unit ? `, ${found.unit}` : ""
      drawn.push(chart(upper, `${found.channel}${unit}`, 240, !pane.below.length))
      if (pane.below.length) drawn.push(chart(pane.below, `${rest.length ? "residual" : "sent"}${unit}`, 170, true))
      summary()
    }

    const zoom = factor => {
      const u = drawn[0]
      const { min, max } = u.scales.x
      const middle = Math.min(Math.max(pane.time[at], min), max)
      const [first, last] = [pane.time[0], pane.time[pane.time.length - 1]]
      const low = factor === 0 ? first : Math.max(first, middle - (middle - min) * factor)
      const high = factor === 0 ? last : Math.min(last, middle + (max - middle) * factor)
      drawn.forEach(each => each.setScale("x", { min: low, max: high }))
    }
    const move = by => {
      at = Math.min(Math.max(at + by, 0), pane.time.length - 1)
      drawn.forEach(each => each.setCursor({ left: each.valToPos(pane.time[at], "x"), top: 10 }, each === drawn[0]))
      const values = drawn.flatMap(each => each.series.slice(1).map((s, k) => `${s.label} ${shown(each.data[k + 1][at])}`))
      said.textContent = `${shown(pane.time[at])} h: ${values.join(", ")} ${pane.unit}`
    }
    charts.addEventListener("mousemove", () => { at = drawn[0].cursor.idx ?? at })
    charts.addEventListener("keydown", event => {
      const act = { ArrowLeft: () => move(event.shiftKey ? -10 : -1), ArrowRight: () => move(event.shiftKey ? 10 : 1),
        "+": () => zoom(0.5), "-": () => zoom(2), 0: () => zoom(0) }[event.key]
      if (act) { act(); event.preventDefault() }
    })

    let width = 0
    const fit = () => {
      if (charts.clientWidth === width || !charts.clientWidth) return
      width = charts.clientWidth
      if (drawn.length) drawn.forEach(u => u.setSize({ width, height: u.height }))
      else draw()
    }
    fit()
    new ResizeObserver(() => requestAnimationFrame(fit)).observe(charts) // also when a closed part opens
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => drawn.length && draw())
  }

  document.documentElement.classList.add("js")
  document.querySelectorAll("figure.viewer").forEach(view)
})()
