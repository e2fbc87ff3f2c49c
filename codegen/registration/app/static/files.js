// Files that are opened and saved.

async function asked(response) {
  if (response.ok) return response
  const kind = response.headers.get("Content-Type") ?? ""
  const found = kind.includes("json") ? (await response.json()).error : (await response.text()).trim()
  throw new Error(response.status === 413 ? "the file is larger than this page takes; use codegen warp" : found)
}

// Send one or two files of a form; what is too large is not sent at all.
export async function upload(address, files, most) {
  const large = [...files].find((file) => file.size > most)
  if (large) throw new Error(`${large.name} has ${Math.ceil(large.size / 2 ** 20)} MB, and ${most / 2 ** 20} MB are allowed; use codegen warp`)
  if (files.length > 2) throw new Error(`${files.length} files were chosen; choose two at most`)
  const form = new FormData()
  for (const file of files) form.append("file", file, file.name)
  return (await asked(await fetch(address, { method: "POST", body: form }))).json()
}

// Let the browser save what the server makes, in as many parts as there are.
export async function download(address, options) {
  for (let part = 0, parts = 1; part < parts; part++) {
    const query = new URLSearchParams({ ...options, part })
    const response = await asked(await fetch(`${address}?${query}`, { method: "POST" }))
    parts = Number(response.headers.get("X-Parts"))
    const name = decodeURIComponent(response.headers.get("Content-Disposition").split("''")[1])
    const link = document.createElement("a")
    link.href = URL.createObjectURL(await response.blob())
    link.download = name
    link.click()
    setTimeout(() => URL.revokeObjectURL(link.href), 10000)
  }
}
