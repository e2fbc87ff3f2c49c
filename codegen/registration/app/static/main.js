// The page: the work, its images, its table and its tools, tied together.

import { setUpControls } from "./controls.js"
import { setUpKeys } from "./keys.js"
import { Link } from "./link.js"
import { Model, other } from "./model.js"
import { MODES, Pane } from "./pane.js"
import { Say } from "./say.js"
import { Table } from "./table.js"
import { Tiles } from "./tiles.js"

const WORK = "work" // argument of the page's address that names the work
const LATER = 60 // milliseconds after which the server is told of another view
const AGAIN = 5000 // milliseconds after which a work that could not be saved is saved again
const MOST_PIXELS = 2.5e6 // of a picture that is asked for

const model = new Model()
const say = new Say(model)
const options = { points: true, names: true, grid: false, live: true, linked: true, time: 1 }
const token = () => new URLSearchParams(location.search).get(WORK) ?? ""

const link = new Link({
  token: token(), heard, packed,
  connected: (is) => say.connection(is, link.unsaved),
  kept: (unsaved) => say.waiting(unsaved),
})
const tiles = new Tiles(
  (digest, level, column, row) => `work/${link.token}/tile/${digest}/${level}/${column}/${row}`,
  512,
  () => panes.forEach((pane) => pane.paint()),
)

let awaited = null // the edit that adds a point, until its pair is known
let added = null // that pair, until it is told what it is
let looked = null
let asked = ""
let again = null

// --- what visitors do --------------------------------------------------------------------------------------------------

export const acts = {
  add(side, place) {
    awaited = link.edit({ do: "add", side, place, awaiting: model.selected })
  },
  clicked(pane, place) {
    const { width, height } = model.images[pane.side]
    const isInside = place[0] >= -0.5 && place[1] >= -0.5 && place[0] <= width - 0.5 && place[1] <= height - 0.5
    if (isInside) acts.add(pane.side, place)
    else acts.chosen(null)
  },
  dragged(pane, id, place) {
    const put = model.put(id, pane.side, place)
    if (put) link.drag({ do: "move", id, side: pane.side, place: put, settled: false, live: options.live })
  },
  dropped(pane, id) {
    acts.settled(id, pane.side, model.pairs.get(id)?.[pane.side])
  },
  placed(id, side, place) {
    acts.settled(id, side, model.put(id, side, place))
    say.place(id, side)
  },
  settled(id, side, place) {
    if (place) model.placed(id, side, link.settle({ do: "move", id, side, place }))
  },
  nudged(side, dx, dy) {
    const pair = model.pairs.get(model.selected)
    if (pair) acts.placed(pair.id, side, [pair[side][0] + dx, pair[side][1] + dy])
  },
  chosen: (id) => model.select(id),
  centred(id) {
    const pair = model.pairs.get(id)
    if (!pair) return
    model.select(id)
    for (const pane of panes) {
      pane.viewport.show(pair[pane.side])
      pane.paint()
    }
    looksOtherwise()
    table.reveal(id)
    say.chosen(id)
  },
  step(by) {
    const { order } = model
    if (!order.length) return
    const k = model.selected === null ? (by > 0 ? -1 : order.length) : order.indexOf(model.selected)
    acts.centred(order[(k + by + order.length) % order.length])
  },
  renamed: (id, name) => link.edit({ do: "rename", id, name }),
  activated: (id, active) => link.edit({ do: "activate", ids: [id], active }),
  toggled() {
    const pair = model.pairs.get(model.selected)
    if (pair) acts.activated(pair.id, !pair.active)
  },
  removed: (ids) => link.edit({ do: "remove", ids }),
  undo: () => link.edit({ do: "undo" }),
  redo: () => link.edit({ do: "redo" }),
  set: (settings) => link.edit({ do: "set", settings: { ...model.settings, ...settings } }),
  chooseSigma: () => link.send({ type: "sigma" }),
  complained: (text) => say.wrong(text),
  moved: (pane) => say.cursor(pane.side, pane.cursor),
  pointed(pane, place) {
    acts.pointer = place && { pane, place }
    say.pointer(pane.side, place)
    const at = place && pane.viewport.toScreen(place)
    pane.stage.dataset.over = at && pane.nearest(at, 9) !== null ? "point" : ""
  },
  // A view was moved: the other views of the same image follow, and where views are linked, those of the other image.
  viewed(pane, moved = false) {
    if (!model.images) return
    for (const another of panes) {
      if (another === pane) continue
      if (another.side === pane.side) copy(pane, another)
      else if (moved && options.linked) follow(pane, another)
      another.paint()
    }
    pane.paint()
    looksOtherwise()
  },
  fit() {
    for (const pane of panes) {
      pane.viewport.fit()
      pane.paint()
    }
    looksOtherwise()
  },
  show(pane, mode) {
    pane.show(mode)
    pane.root.querySelector(".mode").value = mode
    say.legend(panes)
    looksOtherwise()
  },
  third(is = results.root.hidden) {
    results.root.hidden = !is
    document.getElementById("third").setAttribute("aria-pressed", is)
    results.resize()
    copy(fixed, results)
    say.legend(panes)
    looksOtherwise()
  },
  optionsChanged() {
    for (const pane of panes) pane.paint()
    looksOtherwise()
  },
  images: () => panes,
}

// Another view of the same image shows the same; the whole of it where that is seen, whatever the sizes of the views.
function copy({ viewport }, another) {
  if (viewport.isWhole) another.viewport.fit()
  else another.viewport.show(viewport.centre, viewport.zoom)
}

function follow(pane, another) {
  const { side, viewport } = pane
  // A view of the whole image follows to the whole of the other.
  if (viewport.isWhole) another.viewport.fit()
  else another.viewport.show(model.across(side, viewport.centre), viewport.zoom / model.scale(side, viewport.centre))
}

const pane = (name, side) => new Pane(document.getElementById(`pane-${name}`), side, model, tiles, options, acts)
const panes = [pane("moving", "moving"), pane("fixed", "fixed"), pane("result", "fixed")]
const [, fixed, results] = panes
const table = new Table(document.getElementById("drawer"), model, acts)

// --- what the server is asked to show ----------------------------------------------------------------------------------

function looksOtherwise() {
  looked ??= setTimeout(() => {
    looked = null
    const look = wanted()
    const text = JSON.stringify(look)
    if (text === asked) return
    asked = text
    link.send(look)
  }, LATER)
}

function wanted() {
  const shown = panes.find((pane) => pane.needsWarped)
  const look = { type: "look", time: options.time, grid: options.grid && Boolean(shown), window: null }
  const seen = shown?.viewport.seen
  if (!seen) return look
  const { zoom, image } = shown.viewport
  // A little more than is seen, so that small shifts show no margin.
  const [dx, dy] = [(seen[2] - seen[0]) * 0.1, (seen[3] - seen[1]) * 0.1]
  const edges = [Math.max(seen[0] - dx, 0), Math.max(seen[1] - dy, 0), Math.min(seen[2] + dx, image[0]), Math.min(seen[3] + dy, image[1])]
  const [width, height] = [edges[2] - edges[0], edges[3] - edges[1]]
  const scale = Math.min(zoom * shown.ratio, Math.sqrt(MOST_PIXELS / (width * height)))
  return { ...look, window: [...edges, Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale))] }
}

// --- what the server says ----------------------------------------------------------------------------------------------

function heard(message) {
  const answers = {
    hello() {
      rename(message.token)
      controls.offer(message)
      tiles.side = message.tile
      asked = ""
      looksOtherwise()
    },
    moved: () => rename(message.token),
    images: () => model.showImages(message),
    work() {
      model.showWork(message)
      if (!model.pairs.has(added)) return
      model.select(added)
      table.reveal(added)
      say.chosen(added)
      added = null
    },
    solved: () => model.showSolved(message),
    certified: () => model.showCertified(message),
    status: () => say.doing(message.doing),
    message: () => say.message(message.text, message.wrong),
    done() {
      model.confirm(message.number)
      if (message.number !== awaited) return
      awaited = null
      added = message.added
    },
    saved() {
      say.saved(message.problem, link.unsaved)
      clearTimeout(again)
      if (message.problem) again = setTimeout(() => link.send({ type: "save" }), AGAIN)
    },
  }
  answers[message.type]?.()
}

async function packed(header, image) {
  const bitmap = await createImageBitmap(image)
  if (header.type === "areas") for (const pane of panes) pane.areas = bitmap
  else {
    const [first, ...others] = panes.filter((pane) => pane.side === "fixed")
    for (const pane of others) pane.take(header, await createImageBitmap(image))
    first.take(header, bitmap)
    link.send({ type: "drawn", number: header.number })
  }
  for (const pane of panes) pane.paint()
  say.legend(panes)
}

function rename(name) {
  if (name === token()) return
  const address = new URL(location.href)
  address.searchParams.set(WORK, name)
  history.replaceState(null, "", address)
}

model.on((what) => {
  if (what === "images") {
    for (const pane of panes) pane.showImage()
    controls.showImages()
    awaited = null
    asked = ""
    looksOtherwise()
  }
  if (what === "work" || what === "images") table.show()
  else table.refresh()
  if (what === "selected") {
    if (model.selected !== null && !table.body.contains(document.activeElement)) table.reveal(model.selected)
  }
  for (const pane of panes) pane.paint()
  controls.refresh()
  say.refresh()
})

const controls = setUpControls({ model, options, acts, panes, table, link, say, modes: MODES })
setUpKeys({ model, options, acts, panes, table, other })
window.addEventListener("beforeunload", (event) => link.unsaved && event.preventDefault())
window.__page = { model, panes, link } // for whoever looks into the page with the browser's tools
link.connect()
