// The nominal surface as a solid that turns, with the targets of the probe, the tracks of the wheel, and the scallops.
"use strict";
const regrindScene = (() => {
  /** Heights are enlarged until they are this share of the longer side of the part. */
  const MIN_HEIGHT_SHARE = 0.18;
  /** Marks are drawn this far above the surface, in halves of the longer side, so that it does not hide them. */
  const ABOVE = 0.006;
  const FIRST_VIEW = { turn: 0.55, tilt: 0.85, zoom: 1 };

  const VERTEX = `
    attribute vec3 place; attribute vec3 colour; attribute vec3 normal;
    uniform mat4 turn; uniform float size; uniform vec3 light; varying vec3 shade;
    void main() {
      gl_Position = turn * vec4(place, 1.0);
      gl_PointSize = size;
      float lit = length(normal) > 0.0 ? 0.45 + 0.55 * max(0.0, dot(normalize(normal), light)) : 1.0;
      shade = colour * lit;
    }`;
  const FRAGMENT = `
    precision mediump float; varying vec3 shade; uniform bool round;
    void main() {
      if (round && length(gl_PointCoord - 0.5) > 0.5) discard;
      gl_FragColor = vec4(shade, 1.0);
    }`;

  function compiled(gl) {
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    return gl.getProgramParameter(program, gl.LINK_STATUS) ? program : null;
  }

  /** A colour of the look as three shares of 1. */
  function colour(name) {
    const text = getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    return [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);
  }

  /** Five steps from the ground of a scale to its end. */
  const SCALE = [[0.93, 0.93, 0.95], [0.99, 0.82, 0.55], [0.96, 0.57, 0.26], [0.8, 0.27, 0.2], [0.45, 0.05, 0.2]];
  function onScale(share) {
    const at = Math.min(Math.max(share, 0), 1) * (SCALE.length - 1);
    const [low, high] = [SCALE[Math.floor(at)], SCALE[Math.ceil(at)]];
    return low.map((value, k) => value + (high[k] - value) * (at - Math.floor(at)));
  }

  /** The place of the shape in the scene: centred, halves of the longer side, heights enlarged. */
  function frameOf(shape) {
    const { columns, rows, first_mm: first, spacing_mm: spacing, heights_mm: heights } = shape;
    const [wide, deep] = [(columns - 1) * spacing[0], (rows - 1) * spacing[1]];
    const half = Math.max(wide, deep) / 2 || 1;
    const known = heights.filter((z) => z !== null);
    const low = known.reduce((a, b) => Math.min(a, b), Infinity);
    const high = known.reduce((a, b) => Math.max(a, b), -Infinity);
    const range = high - low || Number.MIN_VALUE;
    const times = Math.max(1, (MIN_HEIGHT_SHARE * 2 * half) / range);
    const middle = [first[0] + wide / 2, first[1] + deep / 2, (low + high) / 2];
    const put = (x, y, z, above = 0) => [(x - middle[0]) / half, (y - middle[1]) / half, ((z - middle[2]) * times) / half + above];
    /** Height between the nodes; NaN outside the part. */
    const height = (x, y) => {
      const [u, v] = [Math.min(Math.max((x - first[0]) / spacing[0], 0), columns - 1), Math.min(Math.max((y - first[1]) / spacing[1], 0), rows - 1)];
      const [i, j] = [Math.min(Math.floor(u), columns - 2), Math.min(Math.floor(v), rows - 2)];
      const corners = [heights[j * columns + i], heights[j * columns + i + 1], heights[(j + 1) * columns + i], heights[(j + 1) * columns + i + 1]];
      if (corners.includes(null)) {
        const known = corners.filter((z) => z !== null);
        return known.length ? known[0] : NaN;
      }
      const [a, b] = [u - i, v - j];
      return (corners[0] * (1 - a) + corners[1] * a) * (1 - b) + (corners[2] * (1 - a) + corners[3] * a) * b;
    };
    return { put, height, times, wide, deep, half, range, low, high, step: Math.min(spacing[0], spacing[1]) };
  }

  function mesh(shape, frame, view) {
    const { columns, rows, first_mm: first, spacing_mm: spacing, heights_mm: heights, scallops_nm: scallops } = shape;
    const known = scallops.filter((height) => height !== null);
    const [lowest, highest] = [known.reduce((a, b) => Math.min(a, b), Infinity), known.reduce((a, b) => Math.max(a, b), -Infinity)];
    const plain = [0.78, 0.8, 0.83];
    const vertices = new Float32Array(columns * rows * 9);
    const z = (i, j) => heights[Math.min(Math.max(j, 0), rows - 1) * columns + Math.min(Math.max(i, 0), columns - 1)];
    const slope = (a, b, mm) => (a === null || b === null || !mm ? 0 : ((a - b) * frame.times) / mm);
    for (let j = 0; j < rows; j += 1) {
      for (let i = 0; i < columns; i += 1) {
        const at = j * columns + i;
        if (heights[at] === null) continue;
        const place = frame.put(first[0] + i * spacing[0], first[1] + j * spacing[1], heights[at]);
        const tint = view === "scallops" && scallops.length ? onScale((scallops[at] - lowest) / (highest - lowest || 1)) : plain;
        const dx = slope(z(i + 1, j) ?? heights[at], z(i - 1, j) ?? heights[at], 2 * spacing[0]);
        const dy = slope(z(i, j + 1) ?? heights[at], z(i, j - 1) ?? heights[at], 2 * spacing[1]);
        vertices.set([...place, ...tint, -dx, -dy, 1], 9 * at);
      }
    }
    const triangles = [];
    for (let j = 0; j + 1 < rows; j += 1) {
      for (let i = 0; i + 1 < columns; i += 1) {
        const corners = [j * columns + i, j * columns + i + 1, (j + 1) * columns + i, (j + 1) * columns + i + 1];
        const known = corners.filter((k) => heights[k] !== null);
        if (known.length === 4) triangles.push(corners[0], corners[1], corners[2], corners[1], corners[3], corners[2]);
        else if (known.length === 3) triangles.push(...known);
      }
    }
    return { vertices, triangles: new Uint16Array(triangles), scallops: [lowest, highest] };
  }

  /** Points and lines as vertices without a normal. */
  const marks = (places, tint) => new Float32Array(places.flatMap((place) => [...place, ...tint, 0, 0, 0]));

  function trackLines(shape, frame) {
    return shape.tracks_mm.map((track) => {
      const places = [];
      const add = (x, y) => {
        const z = frame.height(x, y);
        if (!Number.isNaN(z)) places.push(frame.put(x, y, z, ABOVE));
      };
      track.forEach(([x, y], k) => {
        if (k === 0) return add(x, y);
        const [fromX, fromY] = track[k - 1];
        const steps = Math.min(400, Math.max(1, Math.ceil(Math.hypot(x - fromX, y - fromY) / frame.step)));
        for (let step = 1; step <= steps; step += 1) add(fromX + ((x - fromX) * step) / steps, fromY + ((y - fromY) * step) / steps);
        return undefined;
      });
      return places;
    });
  }

  function matrix({ turn, tilt, zoom }, aspect) {
    const [ct, st, cf, sf] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    const s = 0.8 * zoom;
    const [sx, sy] = aspect > 1 ? [s / Math.min(aspect, 1.5), s * aspect / Math.min(aspect, 1.5)] : [s, s * aspect];
    return new Float32Array([
      sx * ct, sy * sf * st, 0.25 * cf * st, 0,
      -sx * st, sy * sf * ct, 0.25 * cf * ct, 0,
      0, sy * cf, -0.25 * sf, 0,
      0, 0, 0, 1]);
  }

  /** Draws the sizes of the part beside its front edges. */
  function drawSizes(canvas, frame, turn) {
    const fine = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    [canvas.width, canvas.height] = [width * fine, height * fine].map(Math.round);
    const context = canvas.getContext("2d");
    context.scale(fine, fine);
    const quiet = getComputedStyle(document.documentElement).getPropertyValue("--quiet").trim();
    [context.strokeStyle, context.fillStyle, context.font, context.textAlign] = [quiet, quiet, "13px Inter, Arial, sans-serif", "center"];
    const onPage = ([x, y, z]) => {
      const at = [0, 1].map((k) => turn[k] * x + turn[4 + k] * y + turn[8 + k] * z);
      return [(0.5 + at[0] / 2) * width, (0.5 - at[1] / 2) * height];
    };
    const [x, y] = [frame.wide / 2 / frame.half, frame.deep / 2 / frame.half];
    const z = (-frame.range * frame.times) / 2 / frame.half;
    const corners = [[-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]].map(onPage);
    context.beginPath();
    corners.forEach(([px, py], k) => (k ? context.lineTo(px, py) : context.moveTo(px, py)));
    context.closePath();
    context.stroke();
    const local = (value) => value.toLocaleString(document.documentElement.lang, { maximumSignificantDigits: 4 });
    const lowest = (a, b) => (corners[a[0]][1] + corners[a[1]][1] > corners[b[0]][1] + corners[b[1]][1] ? a : b);
    for (const [edge, words] of [[lowest([0, 1], [2, 3]), `x ${local(frame.wide)} mm`], [lowest([1, 2], [3, 0]), `y ${local(frame.deep)} mm`]]) {
      const [px, py] = [0, 1].map((k) => (corners[edge[0]][k] + corners[edge[1]][k]) / 2);
      const side = px < width / 2 ? -1 : 1;
      context.textAlign = side < 0 ? "right" : "left";
      const half = context.measureText(words).width;
      const left = Math.min(Math.max(px + side * 10, side < 0 ? half + 4 : 4), side < 0 ? width - 4 : width - half - 4);
      context.fillText(words, left, Math.min(py + 18, height - 4));
    }
  }

  /** Prepares the canvases; nothing where the browser has no WebGL. */
  function prepare(canvas, sizes) {
    const gl = canvas.getContext("webgl", { preserveDrawingBuffer: true, antialias: true });
    const program = gl && compiled(gl);
    if (!program) return null;
    const eye = { ...FIRST_VIEW };
    let [parts, frame] = [[], null];
    const buffer = (target, data) => {
      const made = gl.createBuffer();
      gl.bindBuffer(target, made);
      gl.bufferData(target, data, gl.STATIC_DRAW);
      return made;
    };
    const uniform = (name) => gl.getUniformLocation(program, name);
    const paint = () => {
      const fine = window.devicePixelRatio || 1;
      [canvas.width, canvas.height] = [canvas.clientWidth * fine, canvas.clientHeight * fine].map(Math.round);
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      if (!frame) return;
      gl.enable(gl.DEPTH_TEST);
      gl.useProgram(program);
      const turn = matrix(eye, canvas.width / canvas.height);
      gl.uniformMatrix4fv(uniform("turn"), false, turn);
      gl.uniform1f(uniform("size"), 4.5 * fine);
      gl.uniform3f(uniform("light"), -0.35, -0.45, 0.82);
      for (const { vertices, triangles, count, mode } of parts) {
        gl.bindBuffer(gl.ARRAY_BUFFER, vertices);
        ["place", "colour", "normal"].forEach((name, k) => {
          const at = gl.getAttribLocation(program, name);
          gl.enableVertexAttribArray(at);
          gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 36, 12 * k);
        });
        gl.uniform1i(uniform("round"), mode === gl.POINTS ? 1 : 0);
        if (triangles) {
          gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, triangles);
          gl.drawElements(mode, count, gl.UNSIGNED_SHORT, 0);
        } else gl.drawArrays(mode, 0, count);
      }
      drawSizes(sizes, frame, turn);
    };
    const move = (turn, tilt, zoom = 1) => {
      eye.turn += turn;
      eye.tilt = Math.min(Math.PI / 2, Math.max(0.05, eye.tilt + tilt));
      eye.zoom = Math.min(12, Math.max(0.5, eye.zoom * zoom));
      paint();
    };
    const show = (shape, view) => {
      for (const { vertices, triangles } of parts) [vertices, triangles].forEach((made) => made && gl.deleteBuffer(made));
      frame = frameOf(shape);
      const solid = mesh(shape, frame, view);
      const triangles = buffer(gl.ELEMENT_ARRAY_BUFFER, solid.triangles);
      parts = [{ vertices: buffer(gl.ARRAY_BUFFER, solid.vertices), triangles, count: solid.triangles.length, mode: gl.TRIANGLES }];
      if (view === "surface") {
        const line = colour("--pv");
        for (const places of trackLines(shape, frame)) {
          if (places.length > 1) parts.push({ vertices: buffer(gl.ARRAY_BUFFER, marks(places, line)), count: places.length, mode: gl.LINE_STRIP });
        }
        const places = shape.targets_mm.map(([x, y, z]) => frame.put(x, y, z, 2 * ABOVE));
        if (places.length) parts.push({ vertices: buffer(gl.ARRAY_BUFFER, marks(places, colour("--rms"))), count: places.length, mode: gl.POINTS });
      }
      paint();
      return { times: frame.times, scallopsNm: solid.scallops };
    };
    const clear = () => {
      [parts, frame] = [[], null];
      paint();
      sizes.getContext("2d").clearRect(0, 0, sizes.width, sizes.height);
    };
    const reset = () => {
      Object.assign(eye, FIRST_VIEW);
      paint();
    };
    let from = null;
    canvas.addEventListener("pointerdown", (event) => {
      from = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { from = null; });
    canvas.addEventListener("pointermove", (event) => {
      if (!from) return;
      move((event.clientX - from[0]) / 120, (event.clientY - from[1]) / 120);
      from = [event.clientX, event.clientY];
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      move(0, 0, Math.exp(-event.deltaY / 600));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const steps = {
        ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1], "+": [0, 0, 1.2], "-": [0, 0, 1 / 1.2],
      };
      const step = steps[event.key];
      if (!step) return;
      event.preventDefault();
      move(...step);
    });
    new ResizeObserver(paint).observe(canvas);
    return { show, clear, reset, paint };
  }

  return { prepare, onScale };
})();
