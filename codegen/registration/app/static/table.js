// The table of landmarks. Only the rows that are seen are in the document, so that thousands cost nothing, and only those
// of the chosen row are reached with Tab, so that Tab leaves the table; the arrows go up and down.

import { SIDES } from "./model.js"

const ROW = 27 // height of a row in pixels, as in the style sheet
const BEYOND = 6 // rows above and below those that are seen
const PLACES = [["moving", 0], ["moving", 1], ["fixed", 0], ["fixed", 1]]
const ERRORS = ["residual", "left_out"]
const PIXELS = { residual: "residuals", left_out: "left_out" }
const LENGTHS = { residual: "residual_lengths", left_out: "left_out_lengths" }
const HEADS = { residual: "residual", left_out: "left out" }

export class Table {
  #first = 0
  #rows = new Map() // id -> row in the document
  #shown = []
  #order = { by: "number", down: false }
  units = false // lengths in the images' own unit

  constructor(root, model, acts) {
    Object.assign(this, { root, model, acts })
    this.scroller = root.querySelector(".scroller")
    this.table = root.querySelector("table")
    this.body = root.querySelector("tbody")
    this.search = root.querySelector("input[type=search]")
    this.count = root.querySelector(".count")
    this.scroller.addEventListener("scroll", () => this.#fill())
    this.search.addEventListener("input", () => this.show())
    this.search.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && this.#shown.length) this.acts.centred(this.#shown[0])
    })
    for (const button of root.querySelectorAll("th button")) button.onclick = () => this.#sort(button.dataset.by)
    this.body.addEventListener("keydown", (event) => this.#pressed(event))
    this.body.addEventListener("focusin", (event) => this.#entered(event))
    new ResizeObserver(() => this.#fill()).observe(this.scroller)
  }

  // All rows anew: pairs came or went, or are looked for otherwise.
  show() {
    const { model } = this
    const wanted = this.search.value.trim().toLowerCase()
    const fits = (id, k) => !wanted || String(k + 1) === wanted || model.pairs.get(id).name.toLowerCase().includes(wanted)
    this.#shown = model.order.filter(fits)
    const { by, down } = this.#order
    if (by === "name") this.#shown.sort((a, b) => model.label(a).localeCompare(model.label(b), undefined, { numeric: true }))
    else if (ERRORS.includes(by)) this.#shown.sort((a, b) => (this.#error(by, b) ?? -1) - (this.#error(by, a) ?? -1))
    if (down) this.#shown.reverse()
    const inactive = model.order.filter((id) => !model.pairs.get(id).active).length
    const parts = [`${model.order.length} ${model.order.length === 1 ? "pair" : "pairs"}`]
    if (wanted) parts.unshift(`${this.#shown.length} of`)
    if (inactive) parts.push(`(${inactive} inactive)`)
    this.count.textContent = parts.join(" ")
    this.table.setAttribute("aria-rowcount", this.#shown.length + 1)
    this.#fill()
  }

  #sort(by) {
    this.#order = { by, down: this.#order.by === by && !this.#order.down }
    for (const head of this.root.querySelectorAll("th")) {
      const isIt = head.querySelector("button")?.dataset.by === by
      if (isIt) head.setAttribute("aria-sort", this.#order.down !== ERRORS.includes(by) ? "descending" : "ascending")
      else head.removeAttribute("aria-sort")
    }
    this.show()
  }

  #error(kind, id) {
    const told = kind === "residual" ? this.model.solved : this.#certified
    return told?.[this.#spacing ? LENGTHS[kind] : PIXELS[kind]]?.[id] ?? null
  }

  // The size of the fixed image's pixels, in whose unit errors are shown; null where they are shown in pixels.
  get #spacing() {
    return (this.units && this.model.images?.fixed.spacing) || null
  }

  // What certifies the present pairs, if it is known.
  get #certified() {
    const { certified, revision } = this.model
    return certified && certified.revision === revision ? certified : null
  }

  // Put the rows that are seen into the document, and take others out.
  #fill() {
    const height = this.scroller.clientHeight
    const seen = Math.ceil(height / ROW) + 2 * BEYOND
    const last = Math.max(0, this.#shown.length - seen)
    this.#first = Math.min(Math.max(Math.floor(this.scroller.scrollTop / ROW) - BEYOND, 0), last)
    const wanted = this.#shown.slice(this.#first, this.#first + seen)
    const kept = new Set(wanted)
    const typing = document.activeElement?.closest?.("tr")?.dataset.id
    for (const [id, row] of this.#rows) {
      if (kept.has(id) || String(id) === typing) continue // what is being typed is not taken away
      row.remove()
      this.#rows.delete(id)
    }
    const [above, below] = this.body.querySelectorAll(".spacer")
    above.firstElementChild.style.height = `${this.#first * ROW}px`
    below.firstElementChild.style.height = `${Math.max(0, this.#shown.length - this.#first - wanted.length) * ROW}px`
    let before = above
    wanted.forEach((id, k) => {
      let row = this.#rows.get(id)
      if (!row) this.#rows.set(id, (row = this.#made(id)))
      if (before.nextSibling !== row) before.after(row)
      row.setAttribute("aria-rowindex", this.#first + k + 2)
      before = row
    })
    this.refresh()
  }

  // Numbers and names in the rows that are there.
  refresh() {
    const { model } = this
    const open = this.#shown.includes(model.selected) && this.#rows.has(model.selected) ? model.selected : this.#shown[this.#first]
    const outliers = new Set(this.#certified?.outliers)
    const size = this.#titled()
    for (const [id, row] of this.#rows) {
      const pair = model.pairs.get(id)
      if (!pair) continue
      row.classList.toggle("chosen", id === model.selected)
      row.classList.toggle("inactive", !pair.active)
      row.classList.toggle("outlier", outliers.has(id))
      row.setAttribute("aria-selected", id === model.selected)
      const called = model.label(id)
      for (const control of row.querySelectorAll("input, button")) {
        control.tabIndex = id === open ? 0 : -1
        control.setAttribute("aria-label", `${control.dataset.says} ${called}`)
      }
      row.querySelector(".go").textContent = model.number(id)
      row.querySelector("[type=checkbox]").checked = pair.active
      const [name, ...places] = row.querySelectorAll("input[type=text]")
      if (document.activeElement !== name) name.value = pair.name
      places.forEach((input, k) => {
        const [side, axis] = PLACES[k]
        if (document.activeElement === input && input.dataset.typed) return
        input.value = this.#written(pair[side][axis], side, axis)
        input.classList.toggle("guessed", pair.guessed === side)
      })
      ERRORS.forEach((kind) => {
        const error = this.#error(kind, id)
        row.querySelector(`.${kind}`).textContent = error === null ? "" : inDigits(error, size)
      })
    }
  }

  // Say which unit errors have; the size of a pixel in it, by which digits are chosen.
  #titled() {
    const spacing = this.#spacing
    const unit = !this.units ? "" : spacing ? spacing.unit : "px"
    for (const kind of ERRORS) {
      this.root.querySelector(`th [data-by=${kind}]`).textContent = [HEADS[kind], unit].filter(Boolean).join(" ")
    }
    return spacing ? Math.min(spacing.x, spacing.y) : 1
  }

  #factor(side, axis) {
    const spacing = this.units ? this.model.images[side].spacing : null
    return spacing ? [spacing.x, spacing.y][axis] : 1
  }

  #written(value, side, axis) {
    const factor = this.#factor(side, axis)
    return inDigits(value * factor, factor)
  }

  #made(id) {
    const row = document.createElement("tr")
    row.dataset.id = id
    const cell = (kind, content, says) => {
      const place = row.insertCell()
      place.className = kind
      if (!content) return place
      content.dataset.says = says
      place.append(content)
      return content
    }
    const active = cell("active", document.createElement("input"), "Active:")
    active.type = "checkbox"
    active.onchange = () => this.acts.activated(id, active.checked)
    const go = cell("number", document.createElement("button"), "Centre landmark")
    go.className = "go"
    go.type = "button"
    go.onclick = () => this.acts.centred(id)
    const name = cell("name", field(), "Name of landmark")
    name.onchange = () => this.acts.renamed(id, name.value)
    for (const [side, axis] of PLACES) {
      const input = cell(side, field(), `${side} ${"xy"[axis]} of landmark`)
      input.inputMode = "decimal"
      input.oninput = () => (input.dataset.typed = "1")
      input.onblur = () => this.refresh()
      input.onchange = () => this.#typed(id, side, axis, input)
    }
    for (const kind of ERRORS) cell(kind)
    const gone = cell("gone", document.createElement("button"), "Delete landmark")
    gone.type = "button"
    gone.textContent = "×"
    gone.onclick = () => this.acts.removed([id])
    return row
  }

  #typed(id, side, axis, input) {
    delete input.dataset.typed
    const value = Number(input.value.trim().replace(",", ".")) / this.#factor(side, axis)
    if (input.value.trim() === "" || !Number.isFinite(value)) this.acts.complained(`“${input.value.slice(0, 30)}” is no number`)
    else {
      const place = [...this.model.pairs.get(id)[side]]
      place[axis] = value
      this.acts.placed(id, side, place)
    }
    this.refresh()
  }

  #entered(event) {
    const id = Number(event.target.closest("tr")?.dataset.id)
    if (id) this.acts.chosen(id)
  }

  #pressed(event) {
    const row = event.target.closest("tr")
    const step = { ArrowDown: 1, ArrowUp: -1, Enter: event.target.type === "text" ? 1 : 0 }[event.key]
    if (event.key === "Escape" && event.target.type === "text") {
      delete event.target.dataset.typed
      const pair = this.model.pairs.get(Number(row.dataset.id))
      if (event.target.closest(".name")) event.target.value = pair.name
      event.stopPropagation()
      this.refresh()
    }
    if (!step) return
    event.preventDefault()
    const following = this.#shown[this.#shown.indexOf(Number(row.dataset.id)) + step]
    if (following === undefined) return event.target.dispatchEvent(new Event("change"))
    const column = [...row.querySelectorAll("input, button")].indexOf(event.target)
    this.reveal(following)
    this.#rows.get(following)?.querySelectorAll("input, button")[column]?.focus({ preventScroll: true })
  }

  // Scroll so that a row is seen.
  reveal(id) {
    const k = this.#shown.indexOf(id)
    if (k < 0) return
    const { scrollTop, clientHeight } = this.scroller
    const head = this.table.tHead.offsetHeight
    if (k * ROW < scrollTop) this.scroller.scrollTop = k * ROW
    else if ((k + 1) * ROW + head > scrollTop + clientHeight) this.scroller.scrollTop = (k + 1) * ROW + head - clientHeight
    this.#fill()
  }
}

// A length as text, to about a hundredth of what a pixel is of it.
function inDigits(length, factor) {
  return length.toFixed(factor === 1 ? 2 : Math.min(8, Math.max(2, 2 - Math.floor(Math.log10(factor)))))
}

function field() {
  const input = document.createElement("input")
  input.type = "text"
  input.autocomplete = "off"
  input.spellcheck = false
  return input
}

export function hasUnits(model) {
  return SIDES.some((side) => model.images?.[side].spacing)
}
