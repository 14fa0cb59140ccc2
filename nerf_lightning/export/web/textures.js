// A field and the cells around it as textures, uniforms and constants of march.glsl.

const BRICK = 7;                            // cells along a brick's side, one less than vertices

function makeTexture(gl, target, type, [width, height, depth], data, linear) {
  const [inside, format, numbers] = {
    pairs: [gl.RG8, gl.RG, gl.UNSIGNED_BYTE], halfPairs: [gl.RG16F, gl.RG, gl.HALF_FLOAT],
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

// A linear layer as march.glsl reads it: for each four outputs their bias, the weights of each input column (-1: none), and, if
// three outputs follow, the weights of these. The last three outputs end in their own bias.
function layerOf(compact, name, columns, last) {
  const [weights, bias] = ["weight", "bias"].map(part => compact.floats(`field.${name}.${part}`)), inputs = weights.length / bias.length;
  const row = [], after = last ? compact.floats(`field.${last}.weight`) : [], four = of => { for (let i = 0; i < 4; i++) row.push(of(i)); };
  for (let j = 0; j < bias.length; j += 4) {
    four(i => bias[j + i] ?? 0);
    for (const column of columns) four(i => column >= 0 && j + i < bias.length ? weights[(j + i) * inputs + column] : 0);
    for (let at = j; at < after.length; at += bias.length) four(i => j + i < bias.length ? after[at + i] : 0);
  }
  return last ? [...row, ...compact.floats(`field.${last}.bias`), 0] : row;
}

const inFours = (count, start = 0) => Array.from({ length: 4 * Math.ceil(count / 4) }, (_, i) => i < count ? start + i : -1);
const vectorsOf = row => `vec4[](${Array.from({ length: row.length / 4 }, (_, i) => `vec4(${row.slice(4 * i, 4 * i + 4).map(number)})`)})`;

// The color network of planes.
function networkOf(compact, terms) {
  const width = compact.shape("field.color_net.0.bias")[0], channels = (compact.shape("field.color_net.0.weight")[1] - terms) / 3;
  const columns = [0, 1, 2].flatMap(mode => inFours(channels, mode * channels));
  for (let term = terms - 1; term >= 0; term--) columns.unshift(3 * channels + term);
  return { text: vectorsOf(layerOf(compact, "color_net.0", columns, "color_net.1")), neurons: Math.ceil(width / 4) };
}

// A hash grid with two features a level (kernels/hashgrid.py), and its networks one after another.
const TABLE_WIDTH = 2048;
function hashesOf(gl, compact, about) {
  const { data, low, span } = compact.stored("field.grid.tables"), height = Math.ceil(data.length / 2 / TABLE_WIDTH);
  const texels = new data.constructor(2 * TABLE_WIDTH * height), encode = [];
  texels.set(data);
  let first = 0;
  for (const [side, size] of about.levels) {
    const dense = (side + 1) ** 3 <= size, factors = dense ? [1, side + 1, (side + 1) ** 2] : [1, 2654435761, 805459861];
    encode.push(`level(unit, ${number(side)}, uvec3(${factors.map(x => x + "u")}), ${dense ? 0 : size - 1}u, ${first}u)`);
    first += size;
  }
  if (encode.length % 2) encode.push("vec2(0)");
  const width = compact.shape("field.density_net.0.bias")[0], outputs = compact.shape("field.density_net.1.bias")[0], inputs = encode.length / 2;
  const terms = Array.from({ length: about.terms }, (_, term) => outputs - 1 + term);
  const layers = [
    layerOf(compact, "density_net.0", inFours(2 * about.levels.length)), layerOf(compact, "density_net.1", inFours(width)),
    layerOf(compact, "color_net.0", [...terms, -1, ...inFours(outputs).slice(0, outputs - 1), ...inFours(outputs).slice(outputs)]),
    layerOf(compact, "color_net.1", inFours(width), "color_net.2"),
  ];
  const starts = layers.map((_, i) => layers.slice(0, i).reduce((sum, layer) => sum + layer.length / 4, 0));
  return {
    constants: {
      HASHES: 1, TABLE_WIDTH: TABLE_WIDTH + "u", INPUTS: inputs, OUTPUTS: Math.ceil(outputs / 4), NEURONS: Math.ceil(width / 4), SECOND: starts[1], THIRD: starts[2],
      FOURTH: starts[3], RESIDUAL: number(about.residual), NETWORK: vectorsOf(layers.flat()),
      ENCODE: Array.from({ length: inputs }, (_, i) => `encoded[${i}] = vec4(${encode[2 * i]}, ${encode[2 * i + 1]});`).join(" "),
      ...each("INPUT", inputs), ...each("OUTPUT", Math.ceil(outputs / 4)), ...each("TERM", about.terms), ...each("NEURON", Math.ceil(width / 4)), ...each("HIDDEN", Math.ceil(width / 4)),
    },
    textures: { tables: makeTexture(gl, gl.TEXTURE_2D, data instanceof Uint8Array ? "pairs" : "halfPairs", [TABLE_WIDTH, height], texels, false) },
    ranges: { tableRange: [...low, ...span] },
  };
}

function planesOf(gl, compact, about) {
  const density = volumeOf(gl, compact, "density_volume"), color = volumeOf(gl, compact, "color_volume");
  const { text, neurons } = networkOf(compact, about.terms);
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
