// Landmarks, grid and cursor, drawn over an image.

// Okabe and Ito's colours, which the colour-blind tell apart; black, and yellow on white, are left out.
const COLOURS = ["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"]
const MANY = 150 // landmarks of which only the chosen one is labelled, unless there is room

export function drawMarks(context, { model, side, viewport, options, cursor, grid, carried, focused }) {
  if (options.grid && grid?.[0]?.length) drawGrid(context, viewport, grid)
  if (carried?.length) for (const place of carried) dot(context, viewport.toScreen(place))
  else if (options.points) drawPoints(context, model, side, viewport, options)
  if (cursor && focused) drawCursor(context, viewport.toScreen(cursor))
}

function drawGrid(context, viewport, [xs, ys]) {
  context.beginPath()
  xs.forEach((line, k) =>
    line.forEach((x, j) => {
      const place = viewport.toScreen([x, ys[k][j]])
      if (j) context.lineTo(...place)
      else context.moveTo(...place)
    }),
  )
  stroke(context, 2.5, "#ffffff66")
  stroke(context, 1, "#1a3350b0")
}

function drawPoints(context, model, side, viewport, options) {
  const [width, height] = viewport.size
  const seen = []
  model.order.forEach((id, k) => {
    const place = viewport.toScreen(model.pairs.get(id)[side])
    if (place[0] > -30 && place[1] > -30 && place[0] < width + 30 && place[1] < height + 30) seen.push([id, k, place])
  })
  const labelled = options.names && seen.length <= MANY
  context.font = "600 12px system-ui, sans-serif"
  for (const [id, k, place] of seen) if (id !== model.selected) drawPoint(context, model, side, id, k, place, labelled)
  for (const [id, k, place] of seen) if (id === model.selected) drawPoint(context, model, side, id, k, place, options.names)
}

// A ring whose middle is free, so that the feature under it is seen; dashed where it is only expected.
function drawPoint(context, model, side, id, k, [x, y], labelled) {
  const pair = model.pairs.get(id)
  const isChosen = id === model.selected
  const colour = pair.active ? COLOURS[k % COLOURS.length] : "#8a8f94"
  const radius = isChosen ? 9 : 6
  context.setLineDash([])
  context.beginPath()
  context.arc(x, y, radius, 0, 2 * Math.PI)
  stroke(context, isChosen ? 6 : 4.5, isChosen ? "#000000" : "#ffffff")
  if (isChosen) stroke(context, 4.5, "#ffffff")
  if (pair.guessed === side) context.setLineDash([3, 2.5])
  stroke(context, 2.5, colour)
  context.setLineDash([])
  context.beginPath()
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + 2 * dx, y + 2 * dy)
    context.lineTo(x + (radius - 1) * dx, y + (radius - 1) * dy)
  }
  stroke(context, 3, "#ffffff")
  stroke(context, 1.2, colour)
  if (!pair.active) {
    context.beginPath()
    context.moveTo(x - radius, y + radius)
    context.lineTo(x + radius, y - radius)
    stroke(context, 1.5, colour)
  }
  if (labelled) label(context, model.label(id), x + radius + 4, y - radius + 1)
}

function label(context, text, x, y) {
  context.lineWidth = 3
  context.strokeStyle = "#ffffffe0"
  context.strokeText(text, x, y)
  context.fillStyle = "#10171e"
  context.fillText(text, x, y)
}

function dot(context, [x, y]) {
  context.beginPath()
  context.arc(x, y, 3, 0, 2 * Math.PI)
  context.fillStyle = "#111111"
  context.fill()
  stroke(context, 1.5, "#ffffff")
}

function drawCursor(context, [x, y]) {
  context.beginPath()
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + 4 * dx, y + 4 * dy)
    context.lineTo(x + 16 * dx, y + 16 * dy)
  }
  stroke(context, 4, "#ffffff")
  stroke(context, 1.5, "#b00020")
}

function stroke(context, width, colour) {
  context.lineWidth = width
  context.strokeStyle = colour
  context.stroke()
}
