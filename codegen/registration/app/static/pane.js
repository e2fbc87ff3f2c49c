// One image on the screen, and what a pointer does to it: points are dragged, empty places are clicked, the view is shifted.

import { drawMarks } from "./marks.js"
import { Viewport } from "./viewport.js"

// What can be shown in the frame of the fixed image, and the layers that it takes.
export const MODES = {
  fixed: { title: "Fixed", layers: ["image"] },
  warped: { title: "Warped", layers: ["warped"] },
  overlay: { title: "Overlay", layers: ["image", "warped"] },
  colours: { title: "Green and magenta", layers: ["image", "warped"] },
  flicker: { title: "Flicker", layers: ["image", "warped"] },
  difference: { title: "Difference", layers: ["image", "warped"] },
  checkerboard: { title: "Checkerboard", layers: ["image", "warped"] },
  areas: { title: "Areas", layers: ["warped", "areas"] },
}
const NEAR = { mouse: 9, pen: 12, touch: 22 } // how far from a point it is taken, in the screen's pixels
const STILL = { mouse: 3, pen: 5, touch: 9 } // how far a click may be moved
const SQUARES = 10 // of the checkerboard, along the longer side of the window
const EDGES = ["left", "right", "upper", "lower"]
const SIDES_OF_PATIENT = { R: "right", L: "left", A: "anterior", P: "posterior", I: "inferior", S: "superior" }
const BLINK = 700 // milliseconds

export class Pane {
  viewport = new Viewport()
  ratio = 1 // of the device's pixels to those of the screen
  cursor = null // where keys add a point
  mode = "fixed"
  frame = null // the newest picture of the warped image
  areas = null
  #pointers = new Map()
  #gesture = null
  #isAsked = false

  constructor(root, side, model, tiles, options, acts) {
    Object.assign(this, { root, side, model, tiles, options, acts })
    this.stage = root.querySelector(".stage")
    this.layers = {}
    for (const name of ["image", "warped", "areas", "marks"]) {
      const canvas = document.createElement("canvas")
      canvas.className = `layer ${name}`
      canvas.setAttribute("aria-hidden", "true")
      this.stage.append(canvas)
      this.layers[name] = canvas
    }
    this.edges = EDGES.map((edge) => {
      const letters = document.createElement("span")
      letters.className = `edge ${edge}`
      letters.setAttribute("aria-hidden", "true")
      this.stage.append(letters)
      return letters
    })
    this.orientation = document.createElement("p")
    this.orientation.className = "unseen orientation"
    root.append(this.orientation)
    this.#listen()
    new ResizeObserver(() => this.resize()).observe(this.stage)
  }

  get isShown() {
    return !this.root.hidden
  }

  get needsWarped() {
    return this.isShown && this.side === "fixed" && this.mode !== "fixed"
  }

  // --- size and drawing ----------------------------------------------------------------------------------------------

  resize() {
    const box = this.stage.getBoundingClientRect()
    if (!box.width || !box.height) return
    const wasWhole = this.viewport.isWhole
    this.ratio = window.devicePixelRatio || 1
    this.viewport.size = [box.width, box.height]
    for (const canvas of Object.values(this.layers)) {
      canvas.width = Math.round(box.width * this.ratio)
      canvas.height = Math.round(box.height * this.ratio)
    }
    if (wasWhole) this.viewport.fit()
    this.acts.viewed(this)
    this.paint()
  }

  showImage() {
    const { width, height, edges } = this.model.images[this.side]
    this.edges.forEach((letters, k) => (letters.textContent = edges?.[k] ?? ""))
    const said = EDGES.map((edge, k) => edges && `${edge} edge ${spelled(edges[k])}`).join(", ")
    this.orientation.textContent = edges ? `Shown as stored: ${said}` : ""
    this.viewport.image = [width, height]
    this.frame = this.areas = this.cursor = null
    this.viewport.fit()
    this.paint()
  }

  show(mode) {
    this.mode = mode
    this.stage.dataset.mode = mode
    clearInterval(this.blinking)
    this.layers.warped.classList.remove("away")
    if (mode === "flicker") this.blinking = setInterval(() => this.layers.warped.classList.toggle("away"), BLINK)
    this.paint()
  }

  take(header, bitmap) {
    this.frame?.bitmap.close()
    this.frame = { ...header, bitmap }
    this.paint()
  }

  // Draw soon, once for everything that has changed until then.
  paint() {
    if (this.#isAsked) return
    this.#isAsked = true
    requestAnimationFrame(() => {
      this.#isAsked = false
      this.#paint()
    })
  }

  #paint() {
    const { model, viewport, side } = this
    if (!model.images || !this.isShown) return
    const shown = side === "moving" ? ["image"] : MODES[this.mode].layers
    for (const [name, canvas] of Object.entries(this.layers)) canvas.hidden = name !== "marks" && !shown.includes(name)
    const open = (name) => {
      const context = this.layers[name].getContext("2d")
      context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0)
      context.clearRect(0, 0, ...viewport.size)
      return context
    }
    if (shown.includes("image")) this.tiles.draw(open("image"), model.images[side], viewport, this.ratio)
    if (shown.includes("warped")) this.#paintWarped(open("warped"))
    if (shown.includes("areas")) this.#paintAreas(open("areas"))
    const arrived = side === "moving" || !this.frame || this.frame.time >= 1 || this.mode === "fixed"
    drawMarks(open("marks"), {
      model, side, viewport, options: this.options, cursor: this.cursor,
      grid: side === "moving" ? this.straight : this.mode === "fixed" ? null : this.frame?.grid,
      carried: arrived ? null : this.frame.carried,
      focused: document.activeElement === this.stage,
    })
  }

  #paintWarped(context) {
    if (!this.frame?.window) return
    const [left, top, right, bottom] = this.frame.window
    const corner = this.viewport.toScreen([left - 0.5, top - 0.5])
    const opposite = this.viewport.toScreen([right - 0.5, bottom - 0.5])
    context.save()
    if (this.mode === "checkerboard") clipSquares(context, this.viewport.size)
    context.drawImage(this.frame.bitmap, ...corner, opposite[0] - corner[0], opposite[1] - corner[1])
    context.restore()
  }

  #paintAreas(context) {
    if (!this.areas) return
    const corner = this.viewport.toScreen([-0.5, -0.5])
    const [width, height] = this.viewport.image
    context.drawImage(this.areas, ...corner, width * this.viewport.zoom, height * this.viewport.zoom)
  }

  // --- pointers ------------------------------------------------------------------------------------------------------

  #listen() {
    const { stage } = this
    stage.addEventListener("pointerdown", (event) => this.#pressed(event))
    stage.addEventListener("pointermove", (event) => this.#moved(event))
    for (const end of ["pointerup", "pointercancel"]) stage.addEventListener(end, (event) => this.#released(event))
    stage.addEventListener("pointerleave", () => this.acts.pointed(this, null))
    stage.addEventListener("contextmenu", (event) => event.preventDefault())
    stage.addEventListener("wheel", (event) => this.#turned(event), { passive: false })
    stage.addEventListener("focus", () => this.paint())
    stage.addEventListener("blur", () => this.paint())
  }

  #place(event) {
    const box = this.stage.getBoundingClientRect()
    return [event.clientX - box.left, event.clientY - box.top]
  }

  nearest(at, reach) {
    let [found, least] = [null, reach]
    for (const id of this.options.points ? this.model.order : []) {
      const [x, y] = this.viewport.toScreen(this.model.pairs.get(id)[this.side])
      const distance = Math.hypot(x - at[0], y - at[1]) - (id === this.model.selected ? 3 : 0)
      if (distance < least) [found, least] = [id, distance]
    }
    return found
  }

  #pressed(event) {
    this.stage.focus({ preventScroll: true })
    this.stage.setPointerCapture(event.pointerId)
    const at = this.#place(event)
    this.#pointers.set(event.pointerId, at)
    this.cursor = null
    if (this.#pointers.size === 2) return this.#pinch()
    const id = event.button === 0 && !event.altKey ? this.nearest(at, NEAR[event.pointerType] ?? 9) : null
    if (id !== null) {
      // The point keeps its distance from the pointer, and so follows it from the first pixel.
      const [x, y] = this.viewport.toScreen(this.model.pairs.get(id)[this.side])
      this.#gesture = { kind: "point", id, grip: [x - at[0], y - at[1]], start: at, moved: false }
      this.acts.chosen(id)
    } else this.#gesture = { kind: "empty", start: at, last: at, clicks: event.button === 0, moved: false }
  }

  #pinch() {
    if (this.#gesture?.kind === "point" && this.#gesture.moved) this.acts.dropped(this, this.#gesture.id)
    const [a, b] = [...this.#pointers.values()]
    this.#gesture = { kind: "pinch", distance: Math.hypot(a[0] - b[0], a[1] - b[1]), middle: middle(a, b) }
  }

  #moved(event) {
    const at = this.#place(event)
    this.acts.pointed(this, this.viewport.toImage(at))
    if (!this.#pointers.has(event.pointerId)) return
    this.#pointers.set(event.pointerId, at)
    const gesture = this.#gesture
    if (gesture?.kind === "point") {
      if (at[0] === gesture.start[0] && at[1] === gesture.start[1] && !gesture.moved) return
      gesture.moved = true
      this.acts.dragged(this, gesture.id, this.viewport.toImage([at[0] + gesture.grip[0], at[1] + gesture.grip[1]]))
    } else if (gesture?.kind === "empty") {
      const away = Math.hypot(at[0] - gesture.start[0], at[1] - gesture.start[1])
      gesture.moved ||= away > (STILL[event.pointerType] ?? 3)
      if (!gesture.moved) return
      this.viewport.pan(at[0] - gesture.last[0], at[1] - gesture.last[1])
      gesture.last = at
      this.acts.viewed(this, true)
    } else if (gesture?.kind === "pinch" && this.#pointers.size === 2) {
      const [a, b] = [...this.#pointers.values()]
      const [distance, centre] = [Math.hypot(a[0] - b[0], a[1] - b[1]), middle(a, b)]
      this.viewport.pan(centre[0] - gesture.middle[0], centre[1] - gesture.middle[1])
      this.viewport.zoomAt(Math.log(distance / gesture.distance) / Math.log(1.25), centre)
      Object.assign(gesture, { distance, middle: centre })
      this.acts.viewed(this, true)
    }
  }

  #released(event) {
    this.#pointers.delete(event.pointerId)
    const gesture = this.#gesture
    if (this.#pointers.size) return
    this.#gesture = null
    if (gesture?.kind === "point" && gesture.moved) this.acts.dropped(this, gesture.id)
    const isClick = gesture?.kind === "empty" && !gesture.moved && gesture.clicks && event.type === "pointerup"
    if (isClick) this.acts.clicked(this, this.viewport.toImage(gesture.start))
  }

  #turned(event) {
    event.preventDefault()
    const lines = event.deltaMode === 1 ? event.deltaY * 33 : event.deltaY
    this.viewport.zoomAt(-Math.max(-4, Math.min(4, lines / 100)), this.#place(event))
    this.acts.viewed(this, true)
  }
}

// What a side of the patient is called.
function spelled(letters) {
  return [...letters].map((letter) => SIDES_OF_PATIENT[letter]).join(" ")
}

function middle(a, b) {
  return [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]
}

function clipSquares(context, [width, height]) {
  const side = Math.max(width, height) / SQUARES
  context.beginPath()
  for (let row = 0; row * side < height; row++) {
    for (let column = row % 2; column * side < width; column += 2) context.rect(column * side, row * side, side, side)
  }
  context.clip()
}
