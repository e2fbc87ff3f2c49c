// The work without a pointer: keys that images take, and keys that the page takes wherever nothing is typed.

import { MODES } from "./pane.js"

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }
const FINE = 0.1 // of a pixel of the image
const STRIDE = 10 // of the cursor, in the screen's pixels
const NUDGING = 150 // pixels by which a view is shifted

export function setUpKeys({ model, options, acts, panes, table }) {
  const shown = () => panes.filter((pane) => pane.isShown)
  const focused = () => panes.find((pane) => pane.stage === document.activeElement)

  for (const pane of panes) pane.stage.addEventListener("keydown", (event) => inImage(pane, event))
  document.addEventListener("keydown", (event) => {
    if (event.defaultPrevented || document.querySelector("dialog[open]")) return
    const typed = event.target.closest?.("input:not([type=checkbox]):not([type=range]), select, textarea")
    if ((event.ctrlKey || event.metaKey) && !typed) return command(event)
    if (typed || event.ctrlKey || event.metaKey || event.altKey) return
    const act = anywhere(event)
    if (!act) return
    event.preventDefault()
    act()
  })

  function command(event) {
    const key = event.key.toLowerCase()
    if (key !== "z" && key !== "y") return
    event.preventDefault()
    if (key === "y" || event.shiftKey) acts.redo()
    else acts.undo()
  }

  function anywhere({ key, target }) {
    const mode = Object.keys(MODES)[Number(key) - 1]
    if (mode) return () => compare(mode)
    const known = {
      n: () => acts.step(1),
      p: () => acts.step(-1),
      o: toOther,
      e: nearest,
      l: acts.link,
      r: () => model.alone || acts.third(),
      t: () => acts.list(),
      g: () => document.getElementById("grid").click(),
      f: find,
      d: acts.toggled,
      "+": () => zoom(2),
      "=": () => zoom(2),
      "-": () => zoom(-2),
      0: acts.fit,
      "?": () => document.getElementById("help-sheet").showModal(),
    }
    if (key === "Escape") return () => acts.chosen(null)
    if ((key === "Delete" || key === "Backspace") && model.selected !== null) return () => acts.removed([model.selected])
    return target.closest?.("button, summary") && key === "Enter" ? null : known[key.toLowerCase()]
  }

  function inImage(pane, event) {
    const arrow = ARROWS[event.key]
    if (arrow && !event.ctrlKey && !event.metaKey) {
      event.preventDefault()
      const [dx, dy] = arrow
      if (event.altKey) {
        pane.viewport.pan(-NUDGING * dx, -NUDGING * dy)
        acts.viewed(pane, true)
      } else if (model.selected !== null && !pane.cursor) {
        const step = event.shiftKey ? FINE : 1
        acts.nudged(pane.side, step * dx, step * dy)
        keepInView(pane, model.pairs.get(model.selected)?.[pane.side])
      } else moveCursor(pane, event.shiftKey ? 1 : STRIDE, arrow)
    }
    if (event.key === "Enter" || event.key === "Insert") {
      event.preventDefault()
      pane.cursor ??= pane.viewport.centre
      acts.add(pane.side, pane.cursor)
      pane.cursor = null
    }
    if (event.key === "Escape") pane.cursor = null
  }

  function moveCursor(pane, step, [dx, dy]) {
    const { viewport } = pane
    pane.cursor ??= viewport.centre
    const [x, y] = viewport.toScreen(pane.cursor)
    const place = viewport.toImage([x + step * dx, y + step * dy])
    pane.cursor = place.map((value, k) => Math.min(Math.max(value, -0.5), viewport.image[k] - 0.5))
    keepInView(pane, pane.cursor)
    acts.moved(pane)
    pane.paint()
  }

  function keepInView(pane, place) {
    if (!place) return
    const [x, y] = pane.viewport.toScreen(place)
    const [width, height] = pane.viewport.size
    if (x >= 0 && y >= 0 && x <= width && y <= height) return
    pane.viewport.show(place)
    acts.viewed(pane, true)
  }

  function compare(mode) {
    const here = focused()
    const pane = here?.side === "fixed" ? here : shown().findLast(({ side }) => side === "fixed")
    if (pane) acts.show(pane, mode)
  }

  function toOther() {
    const all = shown()
    const following = all[(all.indexOf(focused()) + 1) % all.length]
    // The pair whose partner is to be placed stays chosen; the cursor stands where the partner is expected.
    following.stage.focus()
    following.paint()
  }

  function nearest() {
    const pane = focused() ?? acts.pointer?.pane ?? panes[0]
    const place = pane.cursor ?? (acts.pointer?.pane === pane ? acts.pointer.place : pane.viewport.centre)
    const id = pane.nearest(pane.viewport.toScreen(place), Infinity)
    pane.cursor = null
    if (id !== null) acts.centred(id)
  }

  function zoom(steps) {
    const pane = focused() ?? panes[0]
    const about = model.pairs.get(model.selected)?.[pane.side] ?? pane.cursor
    pane.viewport.zoomAt(steps, about ? pane.viewport.toScreen(about) : undefined)
    acts.viewed(pane, true)
  }

  function find() {
    acts.list(true)
    table.search.focus()
    table.search.select()
  }
}
