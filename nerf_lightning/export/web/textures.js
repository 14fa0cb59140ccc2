// A field and the cells around it as textures, uniforms and constants of march.glsl.

const BRICK = 7;                            // cells along a brick's side, one less than vertices

function makeTexture(gl, target, type, [width, height, depth], data, linear) {
  const [inside, format, numbers] = {
    bytes: [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE], halves: [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT],
    whole: [gl.R8UI, gl.RED_INTEGER, gl.UNSIGNED_BYTE], places: [gl.RGBA8UI, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE],
  }[type];
  const texture = gl.createTexture();
  gl.bindTexture(target, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  if (depth === undefined) gl.texImage2D(target, 0, inside, width, height, 0, format, numbers, data);
  else gl.texImage3D(target, 0, inside, width, height, depth, 0, format, numbers, data);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T, gl.TEXTURE_WRAP_R]) gl.texParameteri(target, side, gl.CLAMP_TO_EDGE);
  for (const which of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(target, which, linear ? gl.LINEAR : gl.NEAREST);
  return { target, texture };
}

const each = (name, count) => ({ [`EACH_${name}(F)`]: Array.from({ length: count }, (_, i) => `F(${i})`).join(" ") });
const typeOf = data => data instanceof Uint8Array ? "bytes" : "halves";

// Chebyshev distance transform (gaps of march.glsl): two passes over the 26 neighbors (Rosenfeld and Pfaltz 1968), exact.
function gapsOf(occupied, side) {
  const wide = side + 2, gaps = new Uint8Array(wide ** 3).fill(255), before = [];   // with a margin
  const cells = new Int32Array(side ** 3), found = new Uint8Array(side ** 3);
  for (let x = 1, i = 0; x <= side; x++) for (let y = 1; y <= side; y++) for (let z = 1; z <= side; z++, i++) {
    cells[i] = (x * wide + y) * wide + z;
    if (occupied[i]) gaps[cells[i]] = 0;
  }
  for (let x = -1; x <= 1; x++) for (let y = -1; y <= 1; y++) for (let z = -1; z <= 1; z++)
    if (9 * x + 3 * y + z < 0) before.push((x * wide + y) * wide + z);
  for (const way of [1, -1]) for (let i = 0; i < cells.length; i++) {
    const cell = cells[way > 0 ? i : cells.length - 1 - i];
    let least = gaps[cell];
    for (let n = 0; n < before.length && least; n++) least = Math.min(least, gaps[cell + way * before[n]] + 1);
    gaps[cell] = least;
  }
  for (let i = 0; i < cells.length; i++) found[i] = gaps[cells[i]];
  return found;
}

// Planes or lines [3, vertices, C] as layers of four channels, and the ranges of their texels.
function layersOf(gl, compact, name, width, height) {
  const { data, columns, low, span } = compact.stored(name), groups = Math.ceil(columns / 4), places = width * height;
  const texels = new data.constructor(3 * groups * places * 4);
  for (let mode = 0; mode < 3; mode++) for (let place = 0; place < places; place++) for (let c = 0; c < columns; c++)
    texels[((mode * groups + (c >> 2)) * places + place) * 4 + (c & 3)] = data[(mode * places + place) * columns + c];
  const ranges = [low, span].map(row => Array.from({ length: groups * 4 }, (_, c) => row[c] ?? 0));
  return { texture: makeTexture(gl, gl.TEXTURE_2D_ARRAY, typeOf(data), [width, height, 3 * groups], texels, true), groups, ranges };
}

function volumeOf(gl, compact, name) {
  const side = compact.shape(`field.${name}.lines`)[1];
  const planes = layersOf(gl, compact, `field.${name}.planes`, side, side), lines = layersOf(gl, compact, `field.${name}.lines`, side, 1);
  const rows = [...planes.ranges, ...lines.ranges], ranges = [];
  for (let group = 0; group < planes.groups; group++) for (const row of rows) ranges.push(...row.slice(4 * group, 4 * group + 4));
  return { side, groups: planes.groups, planes: planes.texture, lines: lines.texture, ranges };
}

// The color network's weights in the order in which march.glsl reads them.
function networkOf(compact, groups, terms) {
  const [first, bias, second, last] = ["0.weight", "0.bias", "1.weight", "1.bias"].map(part => compact.floats("field.color_net." + part));
  const width = bias.length, inputs = first.length / width, channels = (inputs - terms) / 3, row = [];
  const four = of => { for (let i = 0; i < 4; i++) row.push(of(i)); };
  for (let j = 0; j < width; j += 4) {
    const weight = (i, column) => j + i < width ? first[(j + i) * inputs + column] : 0;
    four(i => bias[j + i] ?? 0);
    for (let term = 0; term < terms; term++) four(i => weight(i, 3 * channels + term));
    for (let mode = 0; mode < 3; mode++) for (let c = 0; c < 4 * groups; c++) four(i => c < channels ? weight(i, mode * channels + c) : 0);
    for (let color = 0; color < 3; color++) four(i => j + i < width ? second[color * width + j + i] : 0);
  }
  row.push(...last, 0);
  const vectors = Array.from({ length: row.length / 4 }, (_, i) => `vec4(${row.slice(4 * i, 4 * i + 4).map(number)})`);
  return { text: `vec4[](${vectors})`, neurons: Math.ceil(width / 4) };
}

function planesOf(gl, compact, about) {
  const density = volumeOf(gl, compact, "density_volume"), color = volumeOf(gl, compact, "color_volume");
  const { text, neurons } = networkOf(compact, color.groups, about.terms);
  const textures = { densityPlanes: density.planes, densityLines: density.lines, colorPlanes: color.planes, colorLines: color.lines };
  return {
    constants: {
      PLANES: 1, DENSITY_GROUPS: density.groups, COLOR_GROUPS: color.groups, DENSITY_SIDE: density.side, COLOR_SIDE: color.side, NEURONS: neurons, NETWORK: text,
      ...each("DENSITY_LAYER", 3 * density.groups), ...each("INPUT", 3 * color.groups), ...each("TERM", about.terms), ...each("NEURON", neurons),
    },
    textures, ranges: { densityRanges: density.ranges, colorRanges: color.ranges },
  };
}

function voxelsOf(gl, compact, about) {
  const kept = compact.bits("field.occupied"), side = Math.round(Math.cbrt(kept.length)), terms = about.terms;
  const rowOf = new Uint32Array(kept.length), bricks = Math.max(1, Math.ceil((side - 1) / BRICK)), used = [];
  for (let i = 0, row = 0; i < kept.length; i++) rowOf[i] = kept[i] ? ++row : 0;
  const vertex = (x, y, z) => x < side && y < side && z < side ? rowOf[(x * side + y) * side + z] : 0;
  const each = visit => { for (let x = 0; x <= BRICK; x++) for (let y = 0; y <= BRICK; y++) for (let z = 0; z <= BRICK; z++) visit(x, y, z); };
  for (let x = 0; x < bricks; x++) for (let y = 0; y < bricks; y++) for (let z = 0; z < bricks; z++) {
    let any = 0;
    each((i, j, k) => { any |= vertex(x * BRICK + i, y * BRICK + j, z * BRICK + k); });
    if (any) used.push([x, y, z]);
  }
  // Bricks fill layers of `across` squared; the parts of the atlas are stacked.
  const size = BRICK + 1, across = Math.max(1, Math.ceil(Math.cbrt(used.length * (1 + terms)))), deep = Math.max(1, Math.ceil(used.length / across ** 2));
  const shape = [across * size, across * size, deep * size * (1 + terms)];
  if (Math.max(...shape) > gl.getParameter(gl.MAX_3D_TEXTURE_SIZE)) throw new Error("This field is too large for this device's graphics.");
  const tables = ["log_density", "colors", "sh_coefficients"].map(name => compact.stored("field." + name));
  const halves = tables.some(table => table.columns && table.data.length && !(table.data instanceof Uint8Array));
  if (halves) for (const table of tables) if (table.data instanceof Uint8Array) {
    const { low, span, columns } = table;
    Object.assign(table, { data: Uint16Array.from(table.data, (value, i) => toHalf(low[i % columns] + value / 255 * span[i % columns])), low: low.map(() => 0), span: span.map(() => 1) });
  }
  const [density, colors, views] = tables, texels = new (halves ? Uint16Array : Uint8Array)(shape[0] * shape[1] * shape[2] * 4);
  const places = new Uint8Array(bricks ** 3 * 4);
  used.forEach(([x, y, z], number) => {
    const slot = [number % across, Math.floor(number / across) % across, Math.floor(number / across ** 2)];
    places.set([...slot, 1], ((x * bricks + y) * bricks + z) * 4);
    each((i, j, k) => {
      const row = vertex(x * BRICK + i, y * BRICK + j, z * BRICK + k);
      const texel = part => 4 * (((slot[2] + part * deep) * size + k) * shape[1] + slot[1] * size + j) * shape[0] + 4 * (slot[0] * size + i);
      texels.set([density.data[row], colors.data[3 * row], colors.data[3 * row + 1], colors.data[3 * row + 2]], texel(0));
      for (let b = 0; b < terms; b++) for (let c = 0; c < 3; c++) texels[texel(1 + b) + c] = views.data[(row * 3 + c) * terms + b];
    });
  });
  const ranges = [density.low[0], ...colors.low, density.span[0], ...colors.span];
  for (let b = 0; b < terms; b++) for (const row of [views.low, views.span]) ranges.push(row[b], row[terms + b], row[2 * terms + b], 0);
  return {
    constants: { SIDE: side, BRICKS: bricks, DENSITY_RATE: number(about.density_lr_scale) },
    textures: {
      bricks: makeTexture(gl, gl.TEXTURE_3D, "places", [bricks, bricks, bricks], places, false),
      atlas: makeTexture(gl, gl.TEXTURE_3D, halves ? "halves" : "bytes", shape, texels, true),
    },
    ranges: { ranges }, atlasSize: shape, partDepth: deep * size,
  };
}

const number = x => Number.isInteger(x) ? x + ".0" : String(x);   // as GLSL wants it
