// What the page says: the state of the registration, places, messages, and for screen readers what was chosen.

import { other } from "./model.js"

const node = (id) => document.getElementById(id)

export class Say {
  #doing = ""
  #problem = null
  #isConnected = true

  constructor(model) {
    this.model = model
    for (const id of ["alert", "remark"]) node(id).querySelector("button").onclick = () => (node(id).hidden = true)
  }

  message(text, isWrong) {
    const [shown, hidden] = isWrong ? ["alert", "remark"] : ["remark", "alert"]
    node(hidden).hidden = true
    node(shown).querySelector("span").textContent = text
    node(shown).hidden = !text
  }

  wrong(text) {
    this.message(text, true)
  }

  doing(text) {
    this.#doing = text
    this.refresh()
  }

  // One line on the registration that is shown.
  refresh() {
    const { solved, certified, revision, order } = this.model
    const state = node("state")
    state.replaceChildren()
    const parts = []
    const isNew = certified && certified.revision === revision
    if (this.#doing) {
      const spinner = document.createElement("i")
      spinner.className = "spinner"
      state.append(spinner)
      parts.push(`${this.#doing} …`)
    }
    if (!order.length) parts.push("no pairs yet: click in an image")
    else if (solved?.found) {
      const residuals = Object.values(solved.residuals)
      if (isNew) {
        // A map that misses its landmarks folds, too, between the pixels that were looked at.
        const folds = certified.folded > 0 || !solved.met
        const verdict = document.createElement("b")
        verdict.className = folds ? "bad" : "good"
        verdict.textContent = folds ? "folds" : "no folding"
        state.append(verdict, " ")
      }
      parts.push(`${residuals.length} ${residuals.length === 1 ? "pair" : "pairs"}`)
      if (isNew && certified.outliers.length) {
        const names = certified.outliers.map((id) => this.model.label(id))
        parts.push(`out of place: ${names.slice(0, 8).join(", ")}${names.length > 8 ? " …" : ""}`)
      }
      parts.push(`residual ≤ ${short(largest(solved.residuals))} px${this.#length(solved)}`)
      if (isNew) {
        parts.push(`areas × ${short(certified.least)} to ${short(certified.most)}`, `round trip ${short(certified.round_trip)} px`)
      } else if (!solved.hasty && !this.#doing) parts.push("certifying …")
      parts.push(`${solved.alignment} alignment, ${solved.steps} steps`)
      if (isNew && certified.note) parts.push(certified.note)
    }
    state.append(parts.join(" · "))
    state.title = state.textContent
  }

  // The largest residual in the unit of the fixed image, if it has one.
  #length({ residual_lengths }) {
    const spacing = this.model.images?.fixed.spacing
    return spacing && residual_lengths ? ` (${short(largest(residual_lengths))} ${spacing.unit})` : ""
  }

  pointer(side, place) {
    const { images } = this.model
    if (!place || !images) return (node("where").textContent = "")
    const there = this.model.across(side, place)
    const parts = [[side, place], [other(side), there]].map(([name, at]) => `${name} ${written(at, images[name].spacing)}`)
    node("where").textContent = parts.join(" ↔ ")
  }

  chosen(id) {
    const pair = this.model.pairs.get(id)
    if (pair) this.#aloud(`Landmark ${this.model.label(id)}: moving ${written(pair.moving)}, fixed ${written(pair.fixed)}`)
  }

  place(id, side) {
    const pair = this.model.pairs.get(id)
    if (pair) this.#aloud(`${side} ${written(pair[side])}`)
  }

  cursor(side, place) {
    this.#aloud(`cursor at ${written(place)} in the ${side} image`)
  }

  #aloud(text) {
    node("said").textContent = text
    node("where").textContent = text
  }

  legend(panes) {
    const pane = panes.find(({ isShown, side, mode }) => isShown && side === "fixed" && mode === "areas")
    const extreme = this.model.certified?.extreme
    node("legend").hidden = !pane || !extreme
    if (!extreme) return
    const [low, high] = node("legend").querySelectorAll("output")
    low.textContent = `areas × ${short(2 ** -extreme)}`
    high.textContent = `× ${short(2 ** extreme)}`
  }

  connection(isConnected, unsaved) {
    this.#isConnected = isConnected
    this.#tell(unsaved)
  }

  waiting(unsaved) {
    if (!this.#isConnected || this.#problem) this.#tell(unsaved)
  }

  saved(problem, unsaved) {
    this.#problem = problem
    this.#tell(unsaved)
  }

  #tell(unsaved) {
    const edits = unsaved ? `, ${unsaved} ${unsaved === 1 ? "edit waits" : "edits wait"}` : ""
    const text = !this.#isConnected ? `no connection to the server${edits}` : this.#problem ? `not saved: ${this.#problem}` : "saved"
    node("saved").textContent = text
    node("saved").classList.toggle("wrong", text !== "saved")
  }
}

function written([x, y], spacing) {
  const pixels = `${x.toFixed(1)}, ${y.toFixed(1)}`
  if (!spacing) return pixels
  const lengths = [x * spacing.x, y * spacing.y].map((length) => Number(length.toPrecision(5)))
  return `${pixels} (${lengths.join(", ")} ${spacing.unit})`
}

function largest(errors) {
  return Object.values(errors).reduce((most, error) => Math.max(most, error ?? NaN), 0)
}

function short(value) {
  if (value === null || !Number.isFinite(value)) return "–"
  return Math.abs(value) > 0 && (Math.abs(value) < 0.01 || Math.abs(value) >= 1e4) ? value.toExponential(0) : Number(value.toPrecision(3)).toString()
}
