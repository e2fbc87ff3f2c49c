// Brightness, contrast and colour maps, as filters of the browser: whatever is drawn later is filtered, too.

// Values from black to white of red, green and blue, between which the browser interpolates; viridis and inferno are
// matplotlib's, at equal distances.
export const MAPS = {
  colours: null,
  grey: [[0, 1], [0, 1], [0, 1]],
  inverted: [[1, 0], [1, 0], [1, 0]],
  green: [[0, 0], [0, 1], [0, 0]],
  magenta: [[0, 1], [0, 0], [0, 1]],
  cyan: [[0, 0], [0, 1], [0, 1]],
  red: [[0, 1], [0, 0], [0, 0]],
  viridis: [
    [0.267, 0.279, 0.23, 0.173, 0.128, 0.158, 0.369, 0.678, 0.993],
    [0.005, 0.175, 0.322, 0.449, 0.567, 0.684, 0.789, 0.864, 0.906],
    [0.329, 0.483, 0.546, 0.558, 0.551, 0.502, 0.383, 0.19, 0.144],
  ],
  inferno: [
    [0.001, 0.129, 0.342, 0.541, 0.736, 0.894, 0.978, 0.975, 0.988],
    [0, 0.047, 0.062, 0.135, 0.216, 0.353, 0.558, 0.798, 0.998],
    [0.014, 0.291, 0.429, 0.415, 0.33, 0.194, 0.035, 0.206, 0.645],
  ],
}

const SVG = "http://www.w3.org/2000/svg"
const GREY = "0.2126 0.7152 0.0722 0 0 ".repeat(3) + "0 0 0 1 0"

// Put the filter of one image into the document: brightness shifts, contrast stretches about the middle.
export function setFilter(id, { brightness, contrast, map }) {
  const filter = document.getElementById(id)
  filter.replaceChildren()
  const slope = contrast <= 1 ? contrast : contrast ** 2
  add(filter, "feComponentTransfer", ["R", "G", "B"].map((channel) => [
    `feFunc${channel}`, { type: "linear", slope, intercept: 0.5 - 0.5 * slope + brightness },
  ]))
  if (MAPS[map]) {
    add(filter, "feColorMatrix", [], { type: "matrix", values: GREY })
    add(filter, "feComponentTransfer", ["R", "G", "B"].map((channel, k) => [
      `feFunc${channel}`, { type: "table", tableValues: MAPS[map][k].join(" ") },
    ]))
  }
}

function add(filter, name, parts, values = {}) {
  const node = filter.appendChild(document.createElementNS(SVG, name))
  for (const [key, value] of Object.entries(values)) node.setAttribute(key, value)
  for (const [part, given] of parts) {
    const inner = node.appendChild(document.createElementNS(SVG, part))
    for (const [key, value] of Object.entries(given)) inner.setAttribute(key, value)
  }
}
