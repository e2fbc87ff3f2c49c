"""What only the browser can do: hand over files in both directions, and tell of keys."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import param
from panel.custom import JSComponent

from codegen.errors import CodegenError, ImageError
from codegen.registration.app.exports import Download

OpenedFiles = Callable[[list[tuple[str, bytes]]], None]


class FileButton(JSComponent):  # type: ignore[misc]
    """A button that opens a file, or up to `count` together; what is too large is refused in the browser and here."""

    label = param.String("Open")
    accept = param.String("")
    most = param.Integer(1 << 20)
    count = param.Integer(1)

    _esm = """
    export function render({ model, el }) {
      const button = document.createElement("button"), input = document.createElement("input")
      button.className = "opener"; button.type = "button"; button.textContent = model.label
      input.type = "file"; input.accept = model.accept; input.hidden = true; input.multiple = model.count > 1
      input.setAttribute("aria-label", model.label)
      button.onclick = () => input.click()
      input.onchange = async () => {
        const files = [...input.files], large = files.find((file) => file.size > model.most)
        if (!files.length) return
        if (large) model.send_msg({ refused: large.name, size: large.size })
        else if (files.length > model.count) model.send_msg({ chosen: files.length })
        else {
          const names = files.map((file) => file.name), data = []
          for (const file of files) data.push(await file.arrayBuffer())
          model.send_msg({ names, data })
        }
        input.value = ""
      }
      model.on("label", () => { button.textContent = model.label })
      el.append(button, input)
    }
    """

    _stylesheets: ClassVar[list[str]] = [
        """
    :host { width: auto; border: none; padding: 0; }
    .opener { font: inherit; font-size: 13px; padding: 5px 10px; border: 1px solid #b9c0c8; border-radius: 6px;
      background: #fff; color: #1c2733; cursor: pointer; white-space: nowrap; }
    .opener:hover { background: #eef3f8; }
    .opener:focus-visible { outline: 2px solid #0072b2; outline-offset: 1px; }
    """
    ]

    def __init__(self, opened: OpenedFiles, failed: Callable[[Exception], None], **values: Any) -> None:
        super().__init__(**values)
        self._opened, self._failed = opened, failed

    def _handle_msg(self, message: Any) -> None:
        """Pass on what the browser sent, whatever that is."""
        try:
            if "refused" in message:
                size = int(message["size"])
                finding = f"the file has {size / 2**20:.0f} MB, and {self.most / 2**20:.0f} MB are allowed"
                raise ImageError(finding, "use codegen warp")
            if "chosen" in message:
                raise ImageError(f"{int(message['chosen'])} files were chosen", f"choose {self.count} at most")
            files = list(zip(message["names"], message["data"], strict=True))
            if not 0 < len(files) <= self.count or not all(
                isinstance(d, bytes | bytearray | memoryview) for _, d in files
            ):
                raise ImageError("no file arrived", "choose it again")
            if (size := max(len(data) for _, data in files)) > self.most:
                raise ImageError(f"the file has {size} bytes, and {self.most} are allowed", "use codegen warp")
            self._opened([(str(name), bytes(data)) for name, data in files])
        except CodegenError as error:
            self._failed(error)
        except (KeyError, TypeError, ValueError):
            self._failed(ImageError("no file arrived", "choose it again"))


class Browser(JSComponent):  # type: ignore[misc]
    """Invisible: saves downloads, and reports keys that no input field takes."""

    _esm = """
    export function render({ model }) {
      model.on("msg:custom", ({ name, kind, data }) => {
        const link = document.createElement("a")
        link.href = URL.createObjectURL(new Blob([data], { type: kind }))
        link.download = name
        link.click()
        setTimeout(() => URL.revokeObjectURL(link.href), 10000)
      })
      const keys = (event) => {
        const target = event.composedPath()[0]
        if (["INPUT", "TEXTAREA", "SELECT"].includes(target.tagName) && target.type !== "checkbox") return
        const command = event.ctrlKey || event.metaKey, key = event.key.toLowerCase()
        let wanted = null
        if (command && key === "z") wanted = event.shiftKey ? "redo" : "undo"
        else if (command && key === "y") wanted = "redo"
        else if (!command && (key === "delete" || key === "backspace")) wanted = "delete"
        else if (!command && key === "escape") wanted = "deselect"
        if (wanted) { event.preventDefault(); model.send_msg({ key: wanted }) }
      }
      document.addEventListener("keydown", keys)
      model.on("remove", () => document.removeEventListener("keydown", keys))
    }
    """

    def __init__(self, pressed: Callable[[str], None], **values: Any) -> None:
        super().__init__(**values)
        self._pressed = pressed

    def _handle_msg(self, message: Any) -> None:
        if isinstance(message, dict) and isinstance(message.get("key"), str):
            self._pressed(message["key"])

    def hand_over(self, download: Download) -> None:
        """Let the browser save a file that exists in memory only."""
        self._send_msg({"name": download.name, "kind": download.kind, "data": download.data})
