// Talks to the server: JSON, and messages of arrays in the safetensors format.

const KINDS = {
  F64: Float64Array, F32: Float32Array, I32: Int32Array, U32: Uint32Array,
  I16: Int16Array, U16: Uint16Array, U8: Uint8Array, I8: Int8Array, BOOL: Uint8Array,
};

// {arrays: {name: {shape, data}}, meta} of a message's bytes.
function decode(buffer) {
  const length = Number(new DataView(buffer).getBigUint64(0, true));
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const arrays = {};
  for (const [name, { dtype, shape, data_offsets }] of Object.entries(header)) {
    if (name === "__metadata__") continue;
    const Kind = KINDS[dtype];
    if (!Kind) throw new Error(`The array ${name} has the type ${dtype}.`);
    const [begin, end] = data_offsets.map((offset) => offset + 8 + length);
    arrays[name] = { shape, data: new Kind(buffer.slice(begin, end)) };
  }
  return { arrays, meta: JSON.parse(header.__metadata__.meta) };
}

// The server's response. A refusal is an error with its message; so is a server that does not respond.
async function request(path, query = {}, options = {}) {
  const response = await fetch(`${path}?${new URLSearchParams(query)}`, options).catch(() => {
    throw new Error("Disconnected: start the studio again and reload.");
  });
  if (!response.ok) throw new Error(`The studio answered ${response.status}: ${(await response.text()).slice(0, 200)}`);
  if (response.headers.has("X-Refused")) throw new Error((await response.json()).error);
  return response;
}

export async function ask(path, query) {
  return (await request(path, query)).json();
}

export async function fetchMessage(path, query) {
  return decode(await (await request(path, query)).arrayBuffer());
}

export async function post(path, body) {
  const options = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  return (await request(path, {}, options)).json();
}

export async function upload(path, file) {
  const options = { method: "POST", headers: { "Content-Type": "application/octet-stream" }, body: file };
  return (await request(path, { name: file.name }, options)).json();
}

// Saves the server's response as a file, under the name in its header.
export async function download(path, query) {
  const response = await request(path, query);
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await response.blob());
  link.download = decodeURIComponent((response.headers.get("Content-Disposition") ?? "").split("''")[1] ?? "motion");
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
