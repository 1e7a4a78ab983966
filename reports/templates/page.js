// Tables sort by a click on a column's head; long ones have a field that filters their rows.
(() => {
  "use strict"
  const FEW = 3
  const MANY = 12
  const raised = "⁰¹²³⁴⁵⁶⁷⁸⁹"
  const valued = cell => {
    const text = cell.textContent.trim().replaceAll("−", "-")
    const found = text.match(/^[<>+]?\s*(-?\d[\d.]*)(?:·10([⁰¹²³⁴⁵⁶⁷⁸⁹]+))?/)
    const power = found && found[2] ? Number([...found[2]].map(c => raised.indexOf(c)).join("")) : 0
    return found ? Number(found[1]) * 10 ** power : text
  }
  const order = (a, b) => {
    if (typeof a === typeof b) return typeof a === "number" ? a - b : a.localeCompare(b)
    return typeof a === "number" ? -1 : 1
  }
  for (const table of document.querySelectorAll(".table table")) {
    const body = table.tBodies[0]
    const rows = [...body.rows]
    if (rows.length < FEW) continue
    const heads = [...table.tHead.rows[0].cells]
    heads.forEach((head, k) => {
      const button = document.createElement("button")
      button.type = "button"
      button.title = "sort"
      button.append(...head.childNodes)
      head.append(button)
      button.addEventListener("click", () => {
        const down = head.getAttribute("aria-sort") === "ascending"
        heads.forEach(h => h.removeAttribute("aria-sort"))
        head.setAttribute("aria-sort", down ? "descending" : "ascending")
        const sorted = rows.map(row => [valued(row.cells[k]), row]).sort((a, b) => (down ? -1 : 1) * order(a[0], b[0]))
        body.append(...sorted.map(([, row]) => row))
      })
    })
    if (rows.length < MANY) continue
    const field = document.createElement("input")
    const counted = document.createElement("span")
    field.type = "search"
    field.placeholder = "filter rows"
    field.setAttribute("aria-label", "Filter rows")
    counted.setAttribute("aria-live", "polite")
    const box = document.createElement("p")
    box.className = "filter"
    box.append(field, counted)
    table.closest(".scroll").before(box)
    field.addEventListener("input", () => {
      const wanted = field.value.toLowerCase().split(/\s+/).filter(Boolean)
      rows.forEach(row => { row.hidden = !wanted.every(w => row.textContent.toLowerCase().includes(w)) })
      counted.textContent = wanted.length ? `${rows.filter(r => !r.hidden).length} of ${rows.length} rows` : ""
    })
  }
})()
