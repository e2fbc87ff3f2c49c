// What the page knows of its work: images, pairs of landmarks, and what the solver found. Whoever shows some of it listens.

export const SIDES = ["moving", "fixed"]
export const other = (side) => (side === "moving" ? "fixed" : "moving")

export class Model {
  images = null // of each side: name, width, height, digest, levels, spacing, edges
  alone = false
  pairs = new Map()
  order = []
  settings = {}
  undo = { undo: false, redo: false }
  selected = null
  solved = null
  chart = null
  certified = null
  #listeners = []
  #local = new Map() // places that were put here and that the server has not confirmed: "id side" -> number of the edit

  on(listener) {
    this.#listeners.push(listener)
  }

  changed(what) {
    for (const listener of this.#listeners) listener(what)
  }

  // --- what the server says ------------------------------------------------------------------------------------------

  showImages({ alone, moving, fixed }) {
    Object.assign(this, { alone, images: { moving, fixed }, solved: null, chart: null, certified: null, selected: null })
    this.changed("images")
  }

  showWork(message) {
    if (message.all) this.pairs.clear()
    for (const [id, mx, my, fx, fy, name, guessed, active] of message.changed) {
      const known = this.pairs.get(id)
      const pair = { id, moving: [mx, my], fixed: [fx, fy], name, guessed, active }
      if (known) for (const side of SIDES) if (this.#local.has(`${id} ${side}`)) pair[side] = known[side]
      this.pairs.set(id, pair)
    }
    if (message.order) {
      this.order = message.order
      const present = new Set(this.order)
      for (const id of this.pairs.keys()) if (!present.has(id)) this.pairs.delete(id)
    }
    if (!this.pairs.has(this.selected)) this.selected = null
    Object.assign(this, { settings: message.settings, undo: { undo: message.undo, redo: message.redo } })
    this.revision = message.revision
    this.changed("work")
  }

  showSolved(message) {
    this.solved = message
    if (message.chart || !message.found) this.chart = message.chart ?? null
    this.changed("solved")
  }

  showCertified(message) {
    this.certified = message
    this.changed("solved")
  }

  confirm(number) {
    for (const [key, last] of this.#local) if (last <= number) this.#local.delete(key)
  }

  // --- what is done here ---------------------------------------------------------------------------------------------

  // Nothing waits for the server: a point is where it was put, within the image.
  put(id, side, [x, y]) {
    const { width, height } = this.images[side]
    const pair = this.pairs.get(id)
    if (!pair) return null
    const place = [Math.min(Math.max(x, -0.5), width - 0.5), Math.min(Math.max(y, -0.5), height - 0.5)]
    this.pairs.set(id, { ...pair, [side]: place, guessed: pair.guessed === side ? null : pair.guessed })
    this.#local.set(`${id} ${side}`, Infinity)
    this.changed("places")
    return place
  }

  placed(id, side, number) {
    this.#local.set(`${id} ${side}`, number)
  }

  select(id) {
    if (id === this.selected) return
    this.selected = id
    this.changed("selected")
  }

  number(id) {
    return this.order.indexOf(id) + 1
  }

  label(id) {
    return this.pairs.get(id)?.name || String(this.number(id))
  }

  // --- where places of one image are in the other --------------------------------------------------------------------

  // By the present map, between the places of its chart; at the same share of the image without a map.
  across(side, [x, y]) {
    const { width, height } = this.images[side]
    const away = this.images[other(side)]
    const u = (x + 0.5) / width
    const v = (y + 0.5) / height
    const chart = this.chart?.[side]
    if (!chart) return [u * away.width - 0.5, v * away.height - 0.5]
    const last = chart.length - 1
    const cell = (share) => Math.min(Math.max(Math.floor(share * last), 0), last - 1)
    const [column, row] = [cell(u), cell(v)]
    const [s, t] = [u * last - column, v * last - row]
    return [0, 1].map((k) => {
      const upper = chart[row][column][k] * (1 - s) + chart[row][column + 1][k] * s
      const lower = chart[row + 1][column][k] * (1 - s) + chart[row + 1][column + 1][k] * s
      return upper * (1 - t) + lower * t
    })
  }

  // How many pixels of the other image one of this image is, on the average of directions.
  scale(side, [x, y]) {
    const { width, height } = this.images[side]
    const step = Math.max(width, height) / 64
    const [a, b, c] = [[x, y], [x + step, y], [x, y + step]].map((place) => this.across(side, place))
    const area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return Math.min(Math.max(Math.sqrt(Math.abs(area)) / step, 0.05), 20)
  }
}
