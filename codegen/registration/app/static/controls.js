// Menus, buttons and settings.

import { MAPS, setFilter } from "./colours.js"
import { download, upload } from "./files.js"
import { hasUnits } from "./table.js"

const node = (id) => document.getElementById(id)
const IMAGES = ".png,.jpg,.jpeg,.tif,.tiff,.nii,.nii.gz,.gz,.nrrd,.mha"
const PLAIN = { brightness: 0, contrast: 1, map: "colours" }

export function setUpControls({ model, options, acts, panes, table, link, say, modes }) {
  let limits = { image: 0, landmarks: 0 }
  let suffixes = []

  const fill = (select, choices) => {
    select.replaceChildren(...Object.entries(choices).map(([value, title]) => new Option(title, value)))
  }
  const click = (id, act) => (node(id).onclick = act)
  const offered = async (act) => {
    try {
      await act()
    } catch (error) {
      say.wrong(error.message)
    }
  }

  // --- menus: one is open at a time; a click elsewhere or Escape closes it -------------------------------------------

  const menus = [...document.querySelectorAll("details.menu")]
  for (const menu of menus) {
    menu.addEventListener("toggle", () => menu.open && menus.forEach((another) => another !== menu && (another.open = false)))
    menu.addEventListener("keydown", (event) => {
      if (event.key !== "Escape") return
      menu.open = false
      menu.querySelector("summary").focus()
      event.stopPropagation()
    })
  }
  document.addEventListener("pointerdown", ({ target }) => menus.forEach((menu) => menu.contains(target) || (menu.open = false)))

  // --- files ---------------------------------------------------------------------------------------------------------

  const chooser = node("chooser")
  const open = (which, files) =>
    offered(async () => {
      const isLandmarks = which === "landmarks"
      const path = isLandmarks ? "landmarks" : `image/${which}`
      say.doing(`opening ${files[0].name}`)
      try {
        const { remark } = await upload(`work/${link.token}/${path}`, files, isLandmarks ? limits.landmarks : limits.image)
        say.message(remark ?? "", false)
      } finally {
        say.doing("")
      }
    })
  for (const button of document.querySelectorAll("[data-open]")) {
    button.onclick = () => {
      const isLandmarks = button.dataset.open === "landmarks"
      chooser.accept = isLandmarks ? suffixes.join(",") : IMAGES
      chooser.multiple = isLandmarks
      chooser.dataset.which = button.dataset.open
      chooser.click()
      button.closest("details").open = false
    }
  }
  chooser.onchange = () => {
    const files = [...chooser.files]
    chooser.value = ""
    if (files.length) open(chooser.dataset.which, files)
  }
  click("example", () => offered(() => fetch(`work/${link.token}/example`, { method: "POST" })))
  for (const button of document.querySelectorAll("[data-save]")) {
    button.onclick = () =>
      offered(async () => {
        button.closest("details").open = false
        say.doing("making the file")
        try {
          await download(`work/${link.token}/export/${button.dataset.save}`, { form: node("format").value, grid: Number(options.grid) })
        } finally {
          say.doing("")
        }
      })
  }
  for (const pane of panes) {
    pane.stage.addEventListener("dragover", (event) => event.preventDefault())
    pane.stage.addEventListener("drop", (event) => {
      event.preventDefault()
      const files = [...event.dataTransfer.files]
      const isImage = /\.(png|jpe?g|tiff?|nii|nii\.gz|nrrd|nhdr|mha|mhd)$/i
      if (files.length) open(files.every(({ name }) => isImage.test(name)) ? pane.side : "landmarks", files)
    })
  }

  // --- view ----------------------------------------------------------------------------------------------------------

  for (const name of ["points", "names", "grid", "live"]) {
    node(name).onchange = () => {
      options[name] = node(name).checked
      if (name === "grid") showStraight()
      acts.optionsChanged()
    }
  }
  node("units").onchange = () => {
    table.units = node("units").checked
    table.refresh()
  }
  node("opacity").oninput = () => document.body.style.setProperty("--opacity", node("opacity").value)
  node("time").oninput = () => {
    options.time = Number(node("time").value)
    node("time-value").textContent = options.time
    acts.optionsChanged()
  }
  const showStraight = () => {
    for (const pane of panes) if (pane.side === "moving") pane.straight = options.grid ? straight(model.images.moving) : null
  }
  for (const pane of panes) {
    const select = pane.root.querySelector(".mode")
    if (select) {
      fill(select, Object.fromEntries(Object.entries(modes).map(([name, { title }]) => [name, title])))
      select.onchange = () => acts.show(pane, select.value)
    }
    for (const button of pane.root.querySelectorAll("[data-zoom]")) {
      button.onclick = () => {
        const steps = Number(button.dataset.zoom)
        if (steps) pane.viewport.zoomAt(2 * steps)
        else pane.viewport.fit()
        acts.viewed(pane, true)
      }
    }
  }
  click("link", () => acts.link())
  acts.link = () => {
    options.linked = !options.linked
    node("link").setAttribute("aria-pressed", options.linked)
    node("link").textContent = options.linked ? "Linked" : "Free"
  }
  click("fit", acts.fit)
  click("third", () => acts.third())
  acts.list = (is = node("drawer").hidden) => {
    node("drawer").hidden = !is
    node("listed").setAttribute("aria-pressed", is)
  }
  click("listed", () => acts.list())
  click("help", () => node("help-sheet").showModal())

  // --- colours -------------------------------------------------------------------------------------------------------

  const colours = { moving: { ...PLAIN }, fixed: { ...PLAIN } }
  const paintColours = () => {
    for (const [side, chosen] of Object.entries(colours)) {
      setFilter(`filter-${side}`, chosen)
      // What changes nothing costs nothing.
      const isPlain = Object.keys(PLAIN).every((key) => chosen[key] === PLAIN[key])
      document.body.style.setProperty(`--filter-${side}`, isPlain ? "none" : `url(#filter-${side})`)
    }
    setFilter("filter-green", { ...colours.fixed, map: "green" })
    setFilter("filter-magenta", { ...colours.moving, map: "magenta" })
  }
  for (const set of document.querySelectorAll("fieldset[data-side]")) {
    fill(set.querySelector("select"), Object.fromEntries(Object.keys(MAPS).map((name) => [name, name])))
    for (const input of set.querySelectorAll("[data-of]")) {
      const title = `${input.closest("label").textContent.trim().split("\n")[0]}, ${set.querySelector("legend").textContent}`
      input.setAttribute("aria-label", input.tagName === "SELECT" ? `Colour map, ${set.querySelector("legend").textContent}` : title)
      input.addEventListener("input", () => {
        colours[set.dataset.side][input.dataset.of] = input.tagName === "SELECT" ? input.value : Number(input.value)
        paintColours()
      })
    }
  }
  click("plain", () => {
    for (const input of document.querySelectorAll("fieldset [data-of]")) input.value = PLAIN[input.dataset.of]
    for (const side of Object.keys(colours)) colours[side] = { ...PLAIN }
    paintColours()
  })
  paintColours()

  // --- registration and pairs ----------------------------------------------------------------------------------------

  for (const name of ["align", "scheme", "interpolation"]) node(name).onchange = () => acts.set({ [name]: node(name).value })
  node("sigma").onchange = () => {
    const sigma = node("sigma").valueAsNumber
    if (sigma >= 0) acts.set({ sigma })
    else refresh()
  }
  click("choose-sigma", acts.chooseSigma)
  click("undo", acts.undo)
  click("redo", acts.redo)
  click("previous", () => acts.step(-1))
  click("next", () => acts.step(1))
  click("delete", () => acts.removed([model.selected]))
  click("toggle-active", acts.toggled)
  click("clear", () => acts.removed([...model.order]))

  function refresh() {
    node("undo").disabled = !model.undo.undo
    node("redo").disabled = !model.undo.redo
    const isChosen = model.selected !== null
    for (const id of ["delete", "toggle-active"]) node(id).disabled = !isChosen
    for (const id of ["previous", "next", "clear"]) node(id).disabled = !model.order.length
    for (const [name, value] of Object.entries(model.settings)) if (document.activeElement !== node(name)) node(name).value = value
    const count = model.order.length
    for (const pane of panes) {
      const what = pane === panes[2] ? "Result" : pane.side === "moving" ? "Moving image" : "Fixed image"
      const chosen = isChosen ? `, landmark ${model.label(model.selected)} chosen` : ""
      pane.stage.setAttribute("aria-label", `${what}, ${count} ${count === 1 ? "landmark" : "landmarks"}${chosen}`)
    }
  }

  return {
    refresh,
    offer(hello) {
      limits = hello.limits
      suffixes = hello.suffixes
      if (!node("format").length) fill(node("format"), hello.formats)
      fill(node("scheme"), Object.fromEntries(Object.entries(hello.schemes).map(([name, note]) => [name, `${name} (${note})`])))
      fill(node("interpolation"), Object.fromEntries(hello.interpolations.map((name) => [name, name])))
      fill(node("align"), Object.fromEntries(hello.alignments.map((name) => [name, name])))
    },
    showImages() {
      const { moving, fixed } = model.images
      const titles = [["Moving", moving], ["Fixed", fixed], ["Result", fixed]]
      panes.forEach((pane, k) => {
        const [what, { name, width, height }] = titles[k]
        const size = document.createElement("small")
        size.textContent = ` ${width} × ${height}`
        pane.root.querySelector("h2").replaceChildren(k === 2 ? what : `${what}: ${name}`, k === 2 ? "" : size)
      })
      // One image alone is bent in the view of the result.
      panes[1].root.hidden = model.alone
      if (model.alone) acts.third(true)
      const mode = panes[2].root.querySelector(".mode").value
      acts.show(panes[2], model.alone || mode === "fixed" ? "warped" : mode)
      node("third").disabled = model.alone
      node("units-line").hidden = !hasUnits(model)
      const units = [moving, fixed].filter(({ spacing }) => spacing).map(({ spacing }) => spacing.unit)
      node("unit").textContent = [...new Set(units)].join(" and ")
      showStraight()
    },
  }
}

const LINES = 16 // squares of the grid along the longer side

function straight({ width, height }) {
  const size = Math.max(width, height) / LINES
  const cut = (length) => {
    const count = Math.max(1, Math.round(length / size))
    return Array.from({ length: count + 1 }, (_, k) => (k * length) / count - 0.5)
  }
  const [xs, ys] = [[], []]
  for (const x of cut(width)) (xs.push([x, x]), ys.push([-0.5, height - 0.5]))
  for (const y of cut(height)) (xs.push([-0.5, width - 0.5]), ys.push([y, y]))
  return [xs, ys]
}
