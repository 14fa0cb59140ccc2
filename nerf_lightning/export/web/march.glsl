// Ray marching, one ray per pixel, with the algorithm and names of sampler/occupancy.py and renderer/renderer.py. The page prepends
// #version and constants: PLANES, HASHES or neither (voxels), UNBOUNDED, TERMS, ... and EACH_INPUT(F), which is F(0) F(1) ..., as loops over arrays are
// slow without a GPU. Positions are in the unit cube, distances in world units.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler3D;
precision highp sampler2DArray;
precision highp usampler3D;

uniform vec3 eye, across, down, ahead;      // pixel (u, v) looks along u across + v down + ahead (Cameras.pixel_axes)
uniform float height;                       // pixels: row 0 is at the top, gl_FragCoord.y = 0 at the bottom
uniform vec4 background;                    // rgb, and 0 where it is transparent
uniform vec3 keepLow, keepHigh;             // the crop box, unit cube
uniform vec2 shades;                        // distances shown as white and as black
uniform int shown;                          // 0 color, 1 depth, 2 opacity, 3 depth as a number
uniform usampler3D gaps;                    // cells to the nearest occupied one (largest of the three axes), 0 in it
out vec4 pixel;

const float NONE = 1e9;

float density(float raw) {                  // layers/activation.py, then from 1 / half-size to 1 / world unit
#if ACTIVATION == 0
  return exp(min(raw, 15.0)) / UNIT;
#elif ACTIVATION == 1
  return max(raw, 0.0) / UNIT;
#else
  return (raw > 20.0 ? raw - 1.0 : log(1.0 + exp(raw - 1.0))) / UNIT;
#endif
}

vec3 sigmoid(vec3 x) { return 1.0 / (1.0 + exp(-x)); }

float harmonics[16];                        // of this ray's direction (kernels/harmonics.py)
void seenAlong(vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  harmonics[0] = 0.28209479;
  harmonics[1] = -0.48860251 * y;
  harmonics[2] = 0.48860251 * z;
  harmonics[3] = -0.48860251 * x;
  harmonics[4] = 1.09254843 * x * y;
  harmonics[5] = -1.09254843 * y * z;
  harmonics[6] = 0.31539157 * (3.0 * zz - 1.0);
  harmonics[7] = -1.09254843 * x * z;
  harmonics[8] = 0.54627422 * (xx - yy);
  harmonics[9] = 0.59004359 * y * (yy - 3.0 * xx);
  harmonics[10] = 2.89061144 * x * y * z;
  harmonics[11] = 0.45704580 * y * (1.0 - 5.0 * zz);
  harmonics[12] = 0.37317633 * z * (5.0 * zz - 3.0);
  harmonics[13] = 0.45704580 * x * (1.0 - 5.0 * zz);
  harmonics[14] = 1.44530572 * z * (xx - yy);
  harmonics[15] = 0.59004359 * x * (3.0 * yy - xx);
}

#ifdef PLANES
// Sums of planes times lines (kernels/vector_matrix.py). Layer m * groups + g holds channels 4g to 4g+3 of mode m; a channel coded
// as bytes is mapped to [low, low + span] after filtering, as both are linear.
uniform sampler2DArray densityPlanes, densityLines, colorPlanes, colorLines;
uniform vec4 densityRanges[4 * DENSITY_GROUPS], colorRanges[4 * COLOR_GROUPS];   // planes' low, span, lines' low, span
const vec4 network[] = NETWORK;             // constant indices only, so that the compiler inlines the weights
const int INPUTS = 3 * COLOR_GROUPS, STRIDE = 1 + TERMS + 4 * INPUTS + 3;         // vec4s for each four neurons

vec3 inTexture(vec3 unit, float side) { return (clamp(unit, 0.0, 1.0) * (side - 1.0) + 0.5) / side; }
vec2 inPlane(vec3 at, int mode) { return mode == 0 ? at.zy : mode == 1 ? at.zx : at.yx; }

// Channels 4g to 4g+3 of a mode of a volume, plane times line.
#define PRODUCT(planes, lines, ranges, groups, layer) \
  (ranges[4 * (layer % groups)] + ranges[4 * (layer % groups) + 1] * texture(planes, vec3(inPlane(at, layer / groups), float(layer)))) * \
  (ranges[4 * (layer % groups) + 2] + ranges[4 * (layer % groups) + 3] * texture(lines, vec3(at[layer / groups], 0.5, float(layer))))

float rawDensity(vec3 unit) {
  vec3 at = inTexture(unit, float(DENSITY_SIDE));
  vec4 total = vec4(0);
#define LAYER(layer) total += PRODUCT(densityPlanes, densityLines, densityRanges, DENSITY_GROUPS, layer);
  EACH_DENSITY_LAYER(LAYER)
  return dot(total, vec4(1));
}

vec4 alongRay[NEURONS];                     // bias and direction terms of each four neurons: constant along the ray
void prepare() {
#define TERM(t) + harmonics[t] * network[first + 1 + t]
#define ALONG(j) { const int first = j * STRIDE; alongRay[j] = network[first] EACH_TERM(TERM); }
  EACH_NEURON(ALONG)
}

vec3 colorAt(vec3 unit) {
  vec3 at = inTexture(unit, float(COLOR_SIDE));
  vec4 products[INPUTS];
#define INPUT(layer) products[layer] = PRODUCT(colorPlanes, colorLines, colorRanges, COLOR_GROUPS, layer);
  EACH_INPUT(INPUT)
  vec3 logits = network[NEURONS * STRIDE].rgb;
  // A hidden layer with ReLU, four neurons at a time (kernels/mlp.py).
#define ADD(i) hidden += mat4(network[w + 4 * i], network[w + 4 * i + 1], network[w + 4 * i + 2], network[w + 4 * i + 3]) * products[i];
#define NEURON(j) { \
    const int w = j * STRIDE + 1 + TERMS, last = w + 4 * INPUTS; \
    vec4 hidden = alongRay[j]; \
    EACH_INPUT(ADD) \
    hidden = max(hidden, 0.0); \
    logits += vec3(dot(network[last], hidden), dot(network[last + 1], hidden), dot(network[last + 2], hidden)); \
  }
  EACH_NEURON(NEURON)
  return sigmoid(logits);
}
#elif defined(HASHES)
// A multiresolution hash grid (kernels/hashgrid.py) and two networks, four neurons at a time (kernels/mlp.py).
uniform sampler2D tables;                   // two features of each entry, level after level
uniform vec4 tableRange;                    // low and span of either
const vec4 network[] = NETWORK;             // layer after layer; constant indices only, as for planes
#define MATRIX(w) mat4(network[w], network[w + 1], network[w + 2], network[w + 3])

// Features of a level. last: the hash's mask, 0 where each vertex has an entry of its own.
vec2 level(vec3 unit, float side, uvec3 factors, uint last, uint first) {
  vec3 place = clamp(unit, 0.0, 1.0) * side, cell = min(floor(place), side - 1.0), part = place - cell;
  uvec3 low = uvec3(cell) * factors, high = low + factors;
#define ENTRY(a, b, c) entry = first + (last == 0u ? a.x + b.y + c.z : (a.x ^ b.y ^ c.z) & last), \
  texelFetch(tables, ivec2(entry % TABLE_WIDTH, entry / TABLE_WIDTH), 0).rg
#define EDGE(b, c) mix((ENTRY(low, b, c)), (ENTRY(high, b, c)), part.x)
  uint entry;
  vec2 near = mix(EDGE(low, low), EDGE(high, low), part.y), away = mix(EDGE(low, high), EDGE(high, high), part.y);
  return tableRange.xy + tableRange.zw * mix(near, away, part.z);
}

vec4 geometry[OUTPUTS];                     // of the density network: raw density, then inputs of the color network
float rawDensity(vec3 unit) {
  vec4 encoded[INPUTS];
  ENCODE
#define BEGIN(k) geometry[k] = network[SECOND + k * (1 + 4 * NEURONS)];
  EACH_OUTPUT(BEGIN)
#define ENTER(i) hidden += MATRIX(w + 4 * i) * encoded[i];
#define LEAVE(k) geometry[k] += MATRIX(to + k * (1 + 4 * NEURONS)) * hidden;
#define NEURON(j) { \
    const int w = j * (1 + 4 * INPUTS) + 1, to = SECOND + 1 + 4 * j; \
    vec4 hidden = network[w - 1]; \
    EACH_INPUT(ENTER) \
    hidden = max(hidden, 0.0); \
    EACH_OUTPUT(LEAVE) \
  }
  EACH_NEURON(NEURON)
  return geometry[0].x;
}

vec4 alongRay[NEURONS];                     // bias and direction terms of each four neurons: constant along the ray
void prepare() {
#define TERM(t) + harmonics[t] * network[w + t]
#define ALONG(j) { const int w = THIRD + j * (1 + TERMS + 4 * OUTPUTS) + 1; alongRay[j] = network[w - 1] EACH_TERM(TERM); }
  EACH_NEURON(ALONG)
}

vec3 colorAt(vec3 unit) {                   // at the position of the last rawDensity
  vec4 first[NEURONS];
#define FROM(k) hidden += MATRIX(w + 4 * k) * geometry[k];
#define FIRST(j) { const int w = THIRD + j * (1 + TERMS + 4 * OUTPUTS) + 1 + TERMS; vec4 hidden = alongRay[j]; EACH_OUTPUT(FROM) first[j] = max(hidden, 0.0); }
  EACH_NEURON(FIRST)
  vec3 logits = network[FOURTH + NEURONS * (4 + 4 * NEURONS)].rgb + RESIDUAL * geometry[0].gba;
#define ADD(i) hidden += MATRIX(w + 4 * i) * first[i];
#define NEXT(j) { \
    const int w = FOURTH + j * (4 + 4 * NEURONS) + 1, last = w + 4 * NEURONS; \
    vec4 hidden = network[w - 1]; \
    EACH_HIDDEN(ADD) \
    hidden = max(hidden, 0.0); \
    logits += vec3(dot(network[last], hidden), dot(network[last + 1], hidden), dot(network[last + 2], hidden)); \
  }
  EACH_NEURON(NEXT)
  return sigmoid(logits);
}
#else
// A sparse voxel grid (kernels/voxels.py) as bricks of 8 x 8 x 8 vertices that share a side with their neighbors: filtering never
// leaves a brick. Part 0 of the atlas holds log-density and color, part 1 + b the coefficients of harmonic 1 + b.
uniform usampler3D bricks;                  // position of each brick in the atlas; alpha 0: pruned
uniform sampler3D atlas;
uniform vec3 atlasSize;                     // texels
uniform float partDepth;                    // texels along z from one part of the atlas to the next
uniform vec4 ranges[2 * (1 + TERMS)];       // low and span of each part
const int BRICK = 7;

vec3 brickPlace = vec3(0.0);
vec4 part(int p) { return ranges[2 * p] + ranges[2 * p + 1] * texture(atlas, (brickPlace + vec3(0, 0, float(p) * partDepth)) / atlasSize); }

vec3 firstColor;
float rawDensity(vec3 unit) {
  vec3 place = clamp(unit, 0.0, 1.0) * float(SIDE - 1);
  ivec3 brick = min(ivec3(place) / BRICK, BRICKS - 1);
  uvec4 slot = texelFetch(bricks, brick.zyx, 0);
  if (slot.a == 0u) return -NONE;
  brickPlace = vec3(slot.xyz) * float(BRICK + 1) + place - vec3(brick * BRICK) + 0.5;
  vec4 found = part(0);
  firstColor = found.gba;
  return DENSITY_RATE * found.r;
}

void prepare() {}

vec3 colorAt(vec3 unit) {                  // at the position of the last rawDensity
  vec3 logits = firstColor;
  for (int b = 1; b <= TERMS; b++) logits += harmonics[b] * part(b).rgb;
  return sigmoid(logits);
}
#endif

vec3 unitOf(vec3 place) {                   // Bounds.to_unit
  vec3 unit = (place - LOW) / SIZE;
#ifdef UNBOUNDED
  vec3 local = 2.0 * unit - 1.0;
  float norm = max(max(abs(local.x), abs(local.y)), max(abs(local.z), 1.0));
  return (2.0 - 1.0 / norm) * (local / norm) * 0.25 + 0.5;
#else
  return unit;
#endif
}

#ifdef UNBOUNDED
float warp(float t, vec2 inside) {          // cameras/bounds.py: samples are even in warped distance
  float before = max((inside.x - t) / UNIT, 0.0), behind = max((t - inside.y) / UNIT, 0.0);
  return 1.0 / (1.0 + before) - 1.0 / (1.0 + behind) + (clamp(t, inside.x, inside.y) - inside.x) / UNIT;
}
float unwarp(float y, vec2 inside) {        // its inverse
  float within = (inside.y - inside.x) / UNIT;
  if (y < 0.0) return inside.x - UNIT * (1.0 / (1.0 + max(y, -1.0 + 1e-6)) - 1.0);
  if (y > within) return inside.y + UNIT * (1.0 / (1.0 - min(y - within, 1.0 - 1e-6)) - 1.0);
  return inside.x + UNIT * y;
}
#endif

void main() {
  vec3 towards = normalize(gl_FragCoord.x * across + (height - gl_FragCoord.y) * down + ahead);
  vec3 safe = mix(towards, vec3(1e-9), lessThan(abs(towards), vec3(1e-9)));
  vec3 one = (LOW - eye) / safe, other = (LOW + SIZE - eye) / safe, first = min(one, other), last = max(one, other);
  vec2 inside = vec2(max(first.x, max(first.y, first.z)), min(last.x, min(last.y, last.z)));
#ifdef UNBOUNDED
  float near = NEAR, far = max(FAR, NEAR);
  if (inside.x >= inside.y) inside = vec2(dot(LOW + 0.5 * SIZE - eye, towards));
  float warpedNear = warp(near, inside), warpedFar = warp(far, inside), edge = near;
#else
  float near = max(inside.x, NEAR), far = min(inside.y, FAR);
#endif
  seenAlong(towards);
  prepare();

  vec3 summed = vec3(0);
  float light = 1.0, opacity = 0.0, reach = 0.0, pending = 0.0;   // light: transmittance; pending: weight without a color yet
  for (int k = 0; k <= SAMPLES; k++) {
#ifdef UNBOUNDED
    float start = edge;
    edge = unwarp(mix(warpedNear, warpedFar, min((float(k) + 0.5) / float(SAMPLES), 1.0)), inside);
    float end = edge;
#else
    float start = near + max(float(k) - 0.5, 0.0) * STEP, end = min(near + (float(k) + 0.5) * STEP, far);
#endif
    if (end <= start) break;
    float t = 0.5 * (start + end);
    vec3 unit = unitOf(eye + t * towards);
    ivec3 cell = clamp(ivec3(unit * float(CELLS)), 0, CELLS - 1);
    int gap = int(texelFetch(gaps, cell.zyx, 0).r);
    if (gap > 0) {
#ifndef UNBOUNDED                                         // leap to the end of the empty cube around this cell
      vec3 wall = vec3(cell) + mix(vec3(1 - gap), vec3(gap), greaterThan(safe, vec3(0)));
      vec3 leave = (LOW + wall / float(CELLS) * SIZE - eye) / safe;
      k = max(k, int(ceil((min(leave.x, min(leave.y, leave.z)) - near) / STEP)) - 1);
#endif
      continue;
    }
    if (any(lessThan(unit, keepLow)) || any(greaterThan(unit, keepHigh))) continue;
    float through = exp(-density(rawDensity(unit)) * (end - start)), weight = light * (1.0 - through);
    pending += weight;
    if (pending > LEAST && shown == 0) {                  // faint samples take the color of the next
      summed += pending * colorAt(unit);
      pending = 0.0;
    }
    if (opacity < 0.5 && opacity + weight >= 0.5) reach = t;   // median depth, as for unbounded scenes
    opacity += weight;
    light *= through;
    if (light < STOP) break;
  }

  if (opacity > pending) summed *= opacity / (opacity - pending);
  if (shown == 0) pixel = vec4(summed + (1.0 - opacity) * background.rgb * background.a, opacity + (1.0 - opacity) * background.a);
  else if (shown == 1) pixel = vec4(vec3(reach > 0.0 ? clamp((shades.y - reach) / (shades.y - shades.x), 0.05, 1.0) : 0.0), 1);
  else if (shown == 2) pixel = vec4(vec3(opacity), 1);
  else {                                                  // thousandths of UNIT, in three bytes
    uint number = uint(clamp(reach / UNIT * 1000.0, 0.0, 16777215.0));
    pixel = vec4(uvec3(number >> 16, (number >> 8) & 255u, number & 255u), 255u) / 255.0;
  }
}
