// Draws the field: coarse pictures while something moves, a fine one in bands when it rests.

const TRIANGLE = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1), 0, 1); }`;
const BAND = 25;                            // milliseconds that one band of a fine picture may take

class Renderer {
  constructor(canvas, compact, about, source) {
    Object.assign(this, { canvas, compact, about, source });
    this.gl = canvas.getContext("webgl2", { alpha: true, antialias: false, depth: false, powerPreference: "high-performance" });
    if (!this.gl) throw new Error("This page needs WebGL 2, which this browser does not offer or has switched off.");
    this.look = { shown: 0, background: [...about.background, 1], keep: [0, 0, 0, 1, 1, 1] };
    this.perPixel = 5e-2;                   // milliseconds, last measurement; initially a guess for a slow machine
    this.rows = 0;                          // finished rows of the fine picture
    this.prepare();
  }

  // GPU resources, lost with the context.
  prepare() {
    const { gl, about } = this, field = ({ planes: planesOf, hashes: hashesOf }[about.kind] ?? voxelsOf)(gl, this.compact, about);
    const { bounds, sampler } = about, vec3 = row => `vec3(${row.map(number)})`;
    const constants = {
      TERMS: about.terms, ACTIVATION: about.activation, UNIT: number(bounds.unit), LOW: vec3(bounds.low), SIZE: vec3(bounds.size),
      NEAR: number(bounds.near), FAR: number(bounds.far), SAMPLES: sampler.samples, STEP: number(sampler.step), CELLS: sampler.cells,
      STOP: number(sampler.stop), LEAST: number(about.least), ...(bounds.unbounded ? { UNBOUNDED: 1 } : {}), ...field.constants,
    };
    const lines = Object.entries(constants).map(([name, value]) => `#define ${name} ${value}\n`);
    this.program = this.link(TRIANGLE, "#version 300 es\n" + lines.join("") + this.source);
    gl.useProgram(this.program);
    const gaps = gapsOf(this.compact.bits("sampler.grid.occupied"), sampler.cells), cells = [sampler.cells, sampler.cells, sampler.cells];
    const textures = { gaps: makeTexture(gl, gl.TEXTURE_3D, "whole", cells, gaps, false), ...field.textures };
    Object.entries(textures).forEach(([name, { target, texture }], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(target, texture);
      gl.uniform1i(this.place(name), unit);
    });
    for (const [name, row] of Object.entries(field.ranges)) gl.uniform4fv(this.place(name), row);
    if (field.atlasSize) {
      gl.uniform3fv(this.place("atlasSize"), field.atlasSize);
      gl.uniform1f(this.place("partDepth"), field.partDepth);
    }
    gl.activeTexture(gl.TEXTURE0 + Object.keys(textures).length);  // separate texture unit for render targets
    this.coarse = this.fine = null;
  }

  link(...sources) {
    const { gl } = this, program = gl.createProgram();
    sources.forEach((source, i) => {
      const shader = gl.createShader(i ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) throw new Error(gl.getShaderInfoLog(shader));
    });
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  place(name) { return this.gl.getUniformLocation(this.program, name); }

  picture(old, width, height) {
    const { gl } = this;
    if (old && old.width === width && old.height === height) return old;
    if (old) { gl.deleteFramebuffer(old.frame); gl.deleteTexture(old.texture); }
    const { texture } = makeTexture(gl, gl.TEXTURE_2D, "bytes", [width, height], null, false), frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    return { frame, texture, width, height };
  }

  // Renders rows of a picture, counted from its lower edge, and measures the time.
  march(camera, picture, low, high, shown = this.look.shown) {
    const { gl, about, look } = this, [across, down, ahead] = camera.axes(picture.width, picture.height), began = performance.now();
    gl.bindFramebuffer(gl.FRAMEBUFFER, picture.frame);
    gl.viewport(0, 0, picture.width, picture.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, low, picture.width, high - low);
    for (const [name, vector] of Object.entries({ eye: camera.eye, across, down, ahead, keepLow: look.keep.slice(0, 3), keepHigh: look.keep.slice(3) }))
      gl.uniform3fv(this.place(name), vector);
    gl.uniform4fv(this.place("background"), look.background);
    gl.uniform1f(this.place("height"), picture.height);
    gl.uniform1i(this.place("shown"), shown);
    const away = Math.hypot(...add(camera.eye, about.focus, -1)), reach = Math.hypot(...about.bounds.size) / 2;
    gl.uniform2f(this.place("shades"), Math.max(0, away - reach), away + reach);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    const one = new Uint8Array(4);
    gl.readPixels(0, low, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, one);  // waits for the picture
    gl.disable(gl.SCISSOR_TEST);
    const pixels = picture.width * (high - low);
    if (pixels > 500) this.perPixel = (performance.now() - began) / pixels;
    return one;
  }

  // A whole picture with as many pixels as `milliseconds` allow, at most `share` of the canvas's sides.
  draw(camera, milliseconds, share) {
    const { width, height } = this.canvas;
    const part = Math.min(share, Math.max(0.08, Math.sqrt(milliseconds / (this.perPixel * width * height))));
    const side = length => Math.max(1, Math.round(length * Math.ceil(part * 12) / 12));  // few sizes, to reuse render targets
    this.coarse = this.picture(this.coarse, side(width), side(height));
    this.march(camera, this.coarse, 0, this.coarse.height);
    this.restart();
    this.present();
  }

  // Starts the fine picture anew.
  restart() { this.rows = 0; }

  // Renders the next band of the picture at rest; false when it is complete.
  refine(camera, share) {
    const width = Math.max(1, Math.round(this.canvas.width * share)), height = Math.max(1, Math.round(this.canvas.height * share));
    this.fine = this.picture(this.fine, width, height);
    if (this.rows >= height) return false;
    const high = Math.min(height, this.rows + Math.max(1, Math.floor(BAND / this.perPixel / width)));
    this.march(camera, this.fine, this.rows, high);
    this.rows = high;
    this.present();
    return high < height;
  }

  present() {
    const { gl, canvas, coarse, fine, rows } = this;
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.clear(gl.COLOR_BUFFER_BIT);          // a browser that empties the canvas itself may do so after the first copy
    const copy = (picture, high) => {
      gl.bindFramebuffer(gl.READ_FRAMEBUFFER, picture.frame);
      gl.blitFramebuffer(0, 0, picture.width, high, 0, 0, canvas.width, Math.round(high / picture.height * canvas.height), gl.COLOR_BUFFER_BIT, gl.LINEAR);
    };
    if (coarse) copy(coarse, coarse.height);
    if (rows) copy(fine, rows);
  }

  // Surface point at a canvas pixel, or null where there is none.
  placeAt(camera, x, y) {
    const { canvas } = this, [across, down, ahead] = camera.axes(canvas.width, canvas.height);
    const direction = unitLength(add(add(ahead, across, x), down, y)), one = this.picture(null, 1, 1);
    const pinhole = Object.assign(Object.create(camera), { axes: () => [[0, 0, 0], [0, 0, 0], direction] });
    const [high, middle, low] = this.march(pinhole, one, 0, 1, 3), distance = (high * 65536 + middle * 256 + low) / 1000 * this.about.bounds.unit;
    this.gl.deleteFramebuffer(one.frame);
    this.gl.deleteTexture(one.texture);
    return distance > 0 ? add(camera.eye, direction, distance) : null;
  }
}
