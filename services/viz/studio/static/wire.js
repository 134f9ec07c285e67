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

// The answer, or what the studio says against it: a refusal is an answer too, and no fault of the network.
async function answered(response) {
  if (!response.ok) throw new Error(`The studio answered ${response.status}: ${(await response.text()).slice(0, 200)}`);
  if (response.headers.has("X-Refused")) throw new Error((await response.json()).error);
  return response;
}

const address = (path, query) => `${path}?${new URLSearchParams(query)}`;

export async function ask(path, query = {}) {
  return (await answered(await fetch(address(path, query)))).json();
}

export async function fetchMessage(path, query = {}) {
  return decode(await (await answered(await fetch(address(path, query)))).arrayBuffer());
}

export async function tell(path, body) {
  const options = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  return (await answered(await fetch(path, options))).json();
}

export async function upload(path, file) {
  const options = { method: "POST", headers: { "Content-Type": "application/octet-stream" }, body: file };
  return (await answered(await fetch(address(path, { name: file.name }), options))).json();
}

// Lets the browser save what the server answers with, under the name that it gives.
export async function download(path, query) {
  const response = await answered(await fetch(address(path, query)));
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await response.blob());
  link.download = decodeURIComponent((response.headers.get("Content-Disposition") ?? "").split("''")[1] ?? "motion");
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
