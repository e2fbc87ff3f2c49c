// The way to the server. Every edit has a number, and is kept until the server says that it has been saved: after a lost
// connection, or another start of the server, those that it has not heard of are sent again.

const client = Array.from(crypto.getRandomValues(new Uint8Array(12)), (byte) => byte.toString(16).padStart(2, "0")).join("")
const RETRY = 1000 // milliseconds

export class Link {
  #socket = null
  #number = 0
  #kept = [] // edits that are not known to be saved, in order
  #move = null // the last move of a drag, while the one before it has not been answered
  #moving = 0 // the number of that one
  #greeted = false

  constructor({ token, heard, packed, connected, kept }) {
    this.token = token
    this.onHeard = heard
    this.onPacked = packed
    this.onConnected = connected
    this.onKept = kept
  }

  get unsaved() {
    return this.#kept.length
  }

  connect() {
    const place = new URL("/socket", location.href)
    place.protocol = "ws:"
    place.search = new URLSearchParams({ client, work: this.token })
    const socket = (this.#socket = new WebSocket(place))
    socket.binaryType = "arraybuffer"
    socket.onmessage = ({ data }) => (typeof data === "string" ? this.#heard(JSON.parse(data)) : this.#packed(data))
    socket.onclose = () => {
      this.#greeted = false
      this.onConnected(false)
      setTimeout(() => this.connect(), RETRY)
    }
  }

  #heard(message) {
    if (message.type === "hello") {
      this.token = message.token
      this.#greeted = true
      this.#number = Math.max(this.#number, message.heard)
      this.#moving = 0
      this.onHeard(message)
      this.onConnected(true)
      for (const edit of this.#kept) if (edit.number > message.heard) this.send(edit)
      return
    }
    if (message.type === "moved") this.token = message.token
    if (message.type === "saved") this.#kept = this.#kept.filter((edit) => edit.number > message.number)
    if (message.type === "done" && message.number >= this.#moving) {
      this.#moving = 0
      const waiting = this.#move
      this.#move = null
      if (waiting) this.#moving = this.edit(waiting)
    }
    this.onHeard(message)
  }

  #packed(data) {
    const length = new DataView(data).getUint32(0, true)
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)))
    const pixels = new Uint8ClampedArray(data.slice(4 + length))
    this.onPacked(header, new ImageData(pixels, header.width, header.height))
  }

  // What is no edit may be lost.
  send(message) {
    if (this.#greeted && this.#socket.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(message))
  }

  edit(act) {
    const message = { ...act, type: "edit", number: ++this.#number }
    const last = this.#kept.at(-1)
    const follows = last?.do === "move" && !last.settled && act.do === "move" && last.id === act.id && last.side === act.side
    if (follows) this.#kept.pop() // of a drag the newest move says all
    this.#kept.push(message)
    this.send(message)
    this.onKept(this.#kept.length)
    return message.number
  }

  // One move of a drag is under way at a time, so that nothing piles up where the machine is slow.
  drag(act) {
    if (this.#moving && this.#greeted) this.#move = act
    else this.#moving = this.edit(act)
  }

  settle(act) {
    this.#move = null
    return this.edit({ ...act, settled: true })
  }
}
