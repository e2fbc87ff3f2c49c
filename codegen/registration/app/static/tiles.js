// Images of any size: of every image only the squares that are seen are fetched, at the size at which they are seen.

const MOST = 300 // tiles that are kept

export class Tiles {
  #kept = new Map()

  constructor(address, side, arrived) {
    this.address = address // (digest, level, column, row) -> where a tile is
    this.side = side
    this.arrived = arrived
  }

  // Draw what is seen of an image; what has not arrived yet is shown coarsely.
  draw(context, image, viewport, ratio) {
    const seen = viewport.seen
    if (!seen) return
    const wanted = Math.min(Math.max(Math.floor(-Math.log2(viewport.zoom * ratio)), 0), image.levels.length - 1)
    context.imageSmoothingEnabled = viewport.zoom < 2
    for (const level of new Set([image.levels.length - 1, wanted])) {
      const span = this.side * 2 ** level
      const [columns, rows] = image.levels[level].map((length) => Math.ceil(length / this.side) - 1)
      for (let row = Math.floor(seen[1] / span); row <= Math.min(Math.floor(seen[3] / span), rows); row++) {
        for (let column = Math.floor(seen[0] / span); column <= Math.min(Math.floor(seen[2] / span), columns); column++) {
          this.#paint(context, image, viewport, level, column, row)
        }
      }
    }
  }

  #paint(context, image, viewport, level, column, row) {
    const tile = this.#get(image.digest, level, column, row)
    if (!tile.complete || !tile.naturalWidth) return
    const span = this.side * 2 ** level
    const [left, top] = viewport.toScreen([column * span - 0.5, row * span - 0.5])
    const width = tile.naturalWidth * 2 ** level * viewport.zoom
    const height = tile.naturalHeight * 2 ** level * viewport.zoom
    context.drawImage(tile, left, top, width, height)
  }

  #get(digest, level, column, row) {
    const key = `${digest} ${level} ${column} ${row}`
    let tile = this.#kept.get(key)
    if (tile) this.#kept.delete(key) // those that were used last stand last
    else {
      tile = new Image()
      tile.onload = this.arrived
      tile.onerror = () => setTimeout(() => this.#kept.delete(key), 2000)
      tile.src = this.address(digest, level, column, row)
    }
    this.#kept.set(key, tile)
    if (this.#kept.size > MOST) this.#kept.delete(this.#kept.keys().next().value)
    return tile
  }
}
