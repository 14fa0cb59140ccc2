// Compact file (runs/compact.py): a zip of .npy arrays and a header with the coding of each.

const NUMBERS = { "|b1": Uint8Array, "|u1": Uint8Array, "<f2": Uint16Array, "<f4": Float32Array, "<i4": Int32Array, "<i8": BigInt64Array };

function fromBase64(text) {
  const letters = atob(text.trim()), bytes = new Uint8Array(letters.length);
  for (let i = 0; i < letters.length; i++) bytes[i] = letters.charCodeAt(i);
  return bytes;
}

async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate-raw"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function fromHalf(bits) {
  const sign = bits & 0x8000 ? -1 : 1, exponent = (bits >> 10) & 31, fraction = bits & 1023;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : fraction * 2 ** -24);
}

function toHalf(value) {
  const size = Math.min(Math.abs(value), 65504), sign = value < 0 ? 0x8000 : 0;
  const exponent = Math.max(Math.floor(Math.log2(size || 1e-9)), -14);
  return sign + ((exponent + 14) << 10) + Math.round(size / 2 ** exponent * 1024);  // a fraction rounded up carries over
}

class Compact {
  static async read(bytes) {
    const file = new DataView(bytes.buffer), arrays = {};
    let end = bytes.length - 22;
    while (file.getUint32(end, true) !== 0x06054b50) end--;
    for (let left = file.getUint16(end + 10, true), at = file.getUint32(end + 16, true); left > 0; left--) {
      const name = new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + file.getUint16(at + 28, true)));
      const local = file.getUint32(at + 42, true);
      const start = local + 30 + file.getUint16(local + 26, true) + file.getUint16(local + 28, true);
      const packed = bytes.subarray(start, start + file.getUint32(at + 20, true));
      arrays[name.replace(/\.npy$/, "")] = Compact.array(file.getUint16(at + 10, true) ? await inflated(packed) : packed);
      at += 46 + file.getUint16(at + 28, true) + file.getUint16(at + 30, true) + file.getUint16(at + 32, true);
    }
    return new Compact(arrays);
  }
  static array(npy) {
    const start = 10 + npy[8] + 256 * npy[9];
    const kind = /'descr': '([^']+)'/.exec(new TextDecoder().decode(npy.subarray(10, start)))[1];
    return new NUMBERS[kind](npy.slice(start).buffer);
  }
  constructor(arrays) {
    this.arrays = arrays;
    this.coded = JSON.parse(new TextDecoder().decode(arrays.header)).arrays;
  }
  shape(name) { return this.coded[name].shape; }
  bits(name) {
    const packed = this.arrays[name], bits = new Uint8Array(this.shape(name).reduce((a, b) => a * b, 1));
    for (let i = 0; i < bits.length; i++) bits[i] = (packed[i >> 3] >> (7 - (i & 7))) & 1;
    return bits;
  }

  // Stored numbers, and per column the range of its texels [0, 1]: bytes are normalized textures.
  stored(name) {
    const shape = this.shape(name), columns = shape.length > 1 ? shape[shape.length - 1] : 1, data = this.arrays[name];
    if (this.coded[name].code !== "byte") return { data, columns, low: new Float32Array(columns), span: new Float32Array(columns).fill(1) };
    const range = this.arrays[name + ":range"], low = range.slice(0, columns), high = range.slice(columns);
    return { data, columns, low, span: high.map((value, i) => value - low[i]) };
  }

  // An array decoded to floats.
  floats(name) {
    const { data, columns, low, span } = this.stored(name);
    if (data instanceof Uint16Array) return Float32Array.from(data, fromHalf);
    if (data instanceof Uint8Array) return Float32Array.from(data, (value, i) => low[i % columns] + value / 255 * span[i % columns]);
    return data;
  }
}
