// The map as a relief that turns. Heights are drawn so that the largest is a fifth of the part's width.
"use strict";
const regrindRelief = (() => {
  /** Height, in halves of the part's longer side, at which the limit of the scale is drawn. */
  const DRAWN_LIMIT = 0.2;
  /** How many times larger the view draws heights than lengths. */
  const RAISED = 1.6;

  const VERTEX = `
    attribute vec3 place; attribute vec3 colour; attribute vec3 normal;
    uniform mat4 turn; varying vec3 shade;
    void main() {
      gl_Position = turn * vec4(place, 1.0);
      shade = colour * (0.55 + 0.45 * abs(normal.z) / length(normal));
    }`;
  const FRAGMENT = "precision mediump float; varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }";

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

  /** At most some 250 nodes along a side: more are not seen, and an index has 16 bits. */
  function mesh(grid, limit, colours) {
    const stride = Math.ceil(Math.max(grid.columns, grid.rows) / 250);
    const [columns, rows] = [grid.columns, grid.rows].map((count) => Math.floor((count - 1) / stride) + 1);
    const [wide, deep] = [(columns - 1) * stride * grid.stepX, (rows - 1) * stride * grid.stepY];
    const size = Math.max(wide, deep) || 1;
    const value = (column, row) => grid.values[row * stride * grid.columns + column * stride];
    const vertices = new Float32Array(columns * rows * 9);
    const height = (column, row) => DRAWN_LIMIT * value(column, row) / limit;
    for (let row = 0; row < rows; row += 1) {
      for (let column = 0; column < columns; column += 1) {
        const [z, at] = [value(column, row), 9 * (row * columns + column)];
        if (Number.isNaN(z)) continue;
        const k = 3 * regrindMap.level(z, limit);
        const x = (2 * column * stride * grid.stepX - wide) / size;
        const y = (2 * row * stride * grid.stepY - deep) / size;
        const slope = (a, b, step) => (Number.isNaN(a) || Number.isNaN(b) || a === undefined || b === undefined ? 0 : (a - b) / step);
        const dx = slope(height(Math.min(column + 1, columns - 1), row), height(Math.max(column - 1, 0), row), 4 * stride * grid.stepX / size);
        const dy = slope(height(column, Math.min(row + 1, rows - 1)), height(column, Math.max(row - 1, 0)), 4 * stride * grid.stepY / size);
        vertices.set([x, y, DRAWN_LIMIT * z / limit, colours[k] / 255, colours[k + 1] / 255, colours[k + 2] / 255, -dx, -dy, 1], at);
      }
    }
    const triangles = [];
    for (let row = 0; row + 1 < rows; row += 1) {
      for (let column = 0; column + 1 < columns; column += 1) {
        const corners = [[column, row], [column + 1, row], [column, row + 1], [column + 1, row + 1]];
        if (corners.some(([c, r]) => Number.isNaN(value(c, r)))) continue;
        const [a, b, c, d] = corners.map(([col, r]) => r * columns + col);
        triangles.push(a, b, c, b, d, c);
      }
    }
    return { vertices, triangles: new Uint16Array(triangles) };
  }

  /** Turned about the vertical, then tilted; seen from far away. */
  function matrix(turn, tilt, aspect) {
    const [ct, st, cf, sf] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    const s = 0.95;
    const [sx, sy] = aspect > 1 ? [s / aspect, s] : [s, s * aspect];
    return new Float32Array([
      sx * ct, sy * sf * st, 0.4 * cf * st, 0,
      -sx * st, sy * sf * ct, 0.4 * cf * ct, 0,
      0, sy * RAISED * cf, -0.4 * sf, 0,
      0, 0, 0, 1]);
  }

  /** How many times larger heights are drawn than lengths. */
  const heightFactor = ({ wide, deep, limit }) => (RAISED * DRAWN_LIMIT * Math.max(wide, deep)) / 2 / (limit / 1000);

  /** Draws the rectangle under the part with its sizes, and the scale of the heights at one of its corners. */
  function drawFrame(canvas, extent, turn) {
    const { wide, deep, limit } = extent;
    const size = Math.max(wide, deep) || 1;
    const fine = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    [canvas.width, canvas.height] = [width * fine, height * fine].map(Math.round);
    const context = canvas.getContext("2d");
    context.scale(fine, fine);
    const style = getComputedStyle(document.documentElement);
    const quiet = style.getPropertyValue("--quiet").trim();
    [context.strokeStyle, context.fillStyle, context.font] = [quiet, quiet, "13px Arial, sans-serif"];
    const onPage = ([x, y, z]) => {
      const at = [0, 1].map((k) => turn[k] * x + turn[4 + k] * y + turn[8 + k] * z);
      return [(0.5 + at[0] / 2) * width, (0.5 - at[1] / 2) * height];
    };
    const line = (...places) => {
      context.beginPath();
      places.map(onPage).forEach(([px, py], k) => (k ? context.lineTo(px, py) : context.moveTo(px, py)));
      context.stroke();
    };
    const [x, y, z] = [wide / size, deep / size, DRAWN_LIMIT];
    line([-x, -y, -z], [x, -y, -z], [x, y, -z], [-x, y, -z], [-x, -y, -z]);
    const text = (words, place, dx, dy) => {
      const [px, py] = onPage(place);
      context.fillText(words, Math.min(Math.max(px + dx, 4), width - 60), Math.min(Math.max(py + dy, 14), height - 4));
    };
    const local = (value, digits) => value.toLocaleString(document.documentElement.lang, { maximumFractionDigits: digits });
    text(`x ${local(wide, 0)} mm`, [0, -y, -z], 0, 18);
    text(`y ${local(deep, 0)} mm`, [x, 0, -z], 8, 14);
    // The corner that lies leftmost has room beside it.
    const corner = [[-x, -y], [x, -y], [x, y], [-x, y]].reduce((a, b) => (onPage([...b, 0])[0] < onPage([...a, 0])[0] ? b : a));
    line([...corner, -z], [...corner, z]);
    for (const share of [-1, 0, 1]) text(`${share > 0 ? "+" : share < 0 ? "−" : ""}${local(Math.abs(share) * limit, 2)}${share ? "" : " µm"}`, [...corner, share * z], -44, 4);
  }

  /** Prepares a canvas; nothing where the browser has no WebGL. */
  function prepare(canvas, frame) {
    const gl = canvas.getContext("webgl", { preserveDrawingBuffer: true, antialias: true });
    const program = gl && compiled(gl);
    if (!program) return null;
    const state = { turn: 0.6, tilt: 0.7, count: 0, extent: null };
    const [vertices, triangles] = [gl.createBuffer(), gl.createBuffer()];
    const paint = () => {
      const fine = window.devicePixelRatio || 1;
      [canvas.width, canvas.height] = [canvas.clientWidth * fine, canvas.clientHeight * fine].map(Math.round);
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      gl.enable(gl.DEPTH_TEST);
      gl.useProgram(program);
      gl.bindBuffer(gl.ARRAY_BUFFER, vertices);
      ["place", "colour", "normal"].forEach((name, k) => {
        const at = gl.getAttribLocation(program, name);
        gl.enableVertexAttribArray(at);
        gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 36, 12 * k);
      });
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, triangles);
      gl.uniformMatrix4fv(gl.getUniformLocation(program, "turn"), false, matrix(state.turn, state.tilt, canvas.width / canvas.height));
      gl.drawElements(gl.TRIANGLES, state.count, gl.UNSIGNED_SHORT, 0);
      if (state.extent) drawFrame(frame, state.extent, matrix(state.turn, state.tilt, canvas.width / canvas.height));
    };
    const turnBy = (turn, tilt) => {
      state.turn += turn;
      state.tilt = Math.min(Math.PI / 2, Math.max(0.05, state.tilt + tilt));
      paint();
    };
    let from = null;
    canvas.addEventListener("pointerdown", (event) => {
      from = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointerup", () => { from = null; });
    canvas.addEventListener("pointermove", (event) => {
      if (!from) return;
      turnBy((event.clientX - from[0]) / 120, (event.clientY - from[1]) / 120);
      from = [event.clientX, event.clientY];
    });
    canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
      if (!step) return;
      event.preventDefault();
      turnBy(...step);
    });
    const show = (grid, limit, colours) => {
      const made = mesh(grid, limit, colours);
      gl.bindBuffer(gl.ARRAY_BUFFER, vertices);
      gl.bufferData(gl.ARRAY_BUFFER, made.vertices, gl.STATIC_DRAW);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, triangles);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, made.triangles, gl.STATIC_DRAW);
      state.count = made.triangles.length;
      state.extent = { wide: grid.columns * grid.stepX, deep: grid.rows * grid.stepY, limit };
      paint();
    };
    return { show, paint };
  }

  return { prepare, heightFactor };
})();
