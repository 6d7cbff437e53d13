// Error maps and points on a canvas: what the server sends in bytes, in the colours of every other picture.
"use strict";
const regrindMap = (() => {
  /** More points than these are drawn as blocks. */
  const MOST_DISCS = 4000;

  /** Reads a map: columns, rows, first node, spacing, values and their sigma in micrometres (NaN where nothing was measured). */
  function readGrid(buffer) {
    const head = new DataView(buffer);
    const [columns, rows] = [head.getUint32(0, true), head.getUint32(4, true)];
    const [firstX, firstY, stepX, stepY] = [8, 16, 24, 32].map((at) => head.getFloat64(at, true));
    const [values, sigma] = [0, 1].map((k) => new Float32Array(buffer, 40 + 4 * k * columns * rows, columns * rows));
    return { columns, rows, firstX, firstY, stepX, stepY, low: -1, values, sigma };
  }

  /** The largest size of some values, and how they are spread. */
  function statistics(values) {
    let [limit, count, squares, low, high] = [0, 0, 0, Infinity, -Infinity];
    for (const value of values) {
      if (Number.isNaN(value)) continue;
      count += 1;
      squares += value * value;
      low = Math.min(low, value);
      high = Math.max(high, value);
      limit = Math.max(limit, Math.abs(value));
    }
    return { limit: limit || 1, count, rms: Math.sqrt(squares / Math.max(count, 1)), pv: count ? high - low : 0 };
  }

  /** The smallest round number that is not below a limit: neighbouring maps then often have the same scale. */
  function roundLimit(limit) {
    const decade = 10 ** Math.floor(Math.log10(limit));
    return [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10].map((k) => k * decade).find((round) => round >= 0.999 * limit) || limit;
  }

  /** Deviations without the plane that fits them best: where the part lies says nothing of its form. */
  function levelled(places, deviations) {
    const known = [];
    for (let k = 0; k < deviations.length; k += 1) if (!Number.isNaN(deviations[k])) known.push(k);
    if (known.length < 3) return deviations;
    const mean = (of) => known.reduce((sum, k) => sum + of(k), 0) / known.length;
    const [x, y] = [(k) => places[2 * k], (k) => places[2 * k + 1]];
    const [x0, y0, d0] = [mean(x), mean(y), mean((k) => deviations[k])];
    const [xx, xy, yy] = [mean((k) => (x(k) - x0) ** 2), mean((k) => (x(k) - x0) * (y(k) - y0)), mean((k) => (y(k) - y0) ** 2)];
    const [xd, yd] = [mean((k) => (x(k) - x0) * deviations[k]), mean((k) => (y(k) - y0) * deviations[k])];
    const determinant = xx * yy - xy * xy;
    // The first row of a pattern tells nothing of the other direction.
    const isFlat = determinant <= 1e-6 * Math.max(xx, yy) ** 2;
    const alongOne = xx >= yy ? [xx > 0 ? xd / xx : 0, 0] : [0, yd / yy];
    const [a, b] = isFlat ? alongOne : [(yy * xd - xy * yd) / determinant, (xx * yd - xy * xd) / determinant];
    return deviations.map((value, k) => value - d0 - a * (x(k) - x0) - b * (y(k) - y0));
  }

  /** The nodes of the lowest and of the highest value. */
  function extremes({ values, columns, firstX, firstY, stepX, stepY }) {
    let [low, high] = [-1, -1];
    for (let k = 0; k < values.length; k += 1) {
      if (Number.isNaN(values[k])) continue;
      if (low < 0 || values[k] < values[low]) low = k;
      if (high < 0 || values[k] > values[high]) high = k;
    }
    const at = (k) => ({ value: values[k], at: [firstX + (k % columns) * stepX, firstY + Math.floor(k / columns) * stepY] });
    return low < 0 ? [] : [low, high].map(at);
  }

  /** 255 colours from below to above, out of hexadecimal digits. */
  function readColours(text) {
    const colours = new Uint8Array(text.length / 2);
    for (let k = 0; k < colours.length; k += 1) colours[k] = parseInt(text.slice(2 * k, 2 * k + 2), 16);
    return colours;
  }

  /** Which of the 255 colours a value has: from -limit to limit, or from 0 where nothing is below (low 0). */
  const level = (value, limit, low = -1) => Math.round((254 * (Math.min(Math.max(value / limit, low), 1) - low)) / (1 - low));

  /** The value of a map between its nodes, straight along x and y; nothing where one of the four was not measured. */
  function valueAt(grid, x, y) {
    const [u, v] = [(x - grid.firstX) / grid.stepX, (y - grid.firstY) / grid.stepY];
    // Maps of one part begin and end within a fraction of a step of each other.
    const [column, row] = [[u, grid.columns], [v, grid.rows]].map(([at, count]) => Math.min(Math.max(Math.floor(at), 0), count - 2));
    const [s, t] = [u - column, v - row];
    if (Math.abs(s - 0.5) > 1 || Math.abs(t - 0.5) > 1) return NaN;
    const node = (c, r) => grid.values[(row + r) * grid.columns + column + c];
    return (1 - t) * ((1 - s) * node(0, 0) + s * node(1, 0)) + t * ((1 - s) * node(0, 1) + s * node(1, 1));
  }

  /** What a map has more than another one, at the nodes of the first. */
  function difference(now, before) {
    const values = now.values.map((value, k) => {
      const [column, row] = [k % now.columns, Math.floor(k / now.columns)];
      return value - valueAt(before, now.firstX + column * now.stepX, now.firstY + row * now.stepY);
    });
    return { ...now, values };
  }

  const local = (value, digits) => value.toLocaleString(document.documentElement.lang, { minimumFractionDigits: digits, maximumFractionDigits: digits });

  /** Round steps over a range, some five of them. */
  function ticks(low, high) {
    const rough = (high - low) / 5;
    const decade = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((k) => k * decade).find((s) => s >= rough) || decade;
    const found = [];
    for (let tick = Math.ceil(low / step) * step; tick <= high + 1e-9 * step; tick += step) found.push(tick);
    return found.map((tick) => [tick, Number(tick.toPrecision(6)).toLocaleString(document.documentElement.lang, { maximumFractionDigits: 6 }).replace("-", "−")]);
  }

  /** Makes a canvas as fine as the screen, and returns its context and its size in the pixels of the page. */
  function prepared(canvas) {
    const { clientWidth: width, clientHeight: height } = canvas;
    const fine = window.devicePixelRatio || 1;
    canvas.width = Math.round(width * fine);
    canvas.height = Math.round(height * fine);
    const context = canvas.getContext("2d");
    context.scale(fine, fine);
    const style = getComputedStyle(document.documentElement);
    const [ink, quiet, ground] = ["--ink", "--quiet", "--ground"].map((name) => style.getPropertyValue(name).trim());
    context.font = "13px Arial, sans-serif";
    return { context, width, height, ink, quiet, ground };
  }

  /** The pixels of a map, one a node, y upwards. */
  function picture(grid, limit, colours) {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [grid.columns, grid.rows];
    const image = new ImageData(grid.columns, grid.rows);
    for (let row = 0; row < grid.rows; row += 1) {
      for (let column = 0; column < grid.columns; column += 1) {
        const value = grid.values[row * grid.columns + column];
        if (Number.isNaN(value)) continue;
        const at = 4 * ((grid.rows - 1 - row) * grid.columns + column);
        image.data.set(colours.subarray(3 * level(value, limit, grid.low), 3 * level(value, limit, grid.low) + 3), at);
        image.data[at + 3] = 255;
      }
    }
    canvas.getContext("2d").putImageData(image, 0, 0);
    return canvas;
  }

  /** Where the part lies: the bounds of a map, or else of some points. */
  function bounds(grid, places) {
    if (grid) {
      return [grid.firstX - grid.stepX / 2, grid.firstY - grid.stepY / 2,
        grid.firstX + (grid.columns - 0.5) * grid.stepX, grid.firstY + (grid.rows - 0.5) * grid.stepY];
    }
    let [x0, y0, x1, y1] = [Infinity, Infinity, -Infinity, -Infinity];
    for (const [x, y] of places) [x0, y0, x1, y1] = [Math.min(x0, x), Math.min(y0, y), Math.max(x1, x), Math.max(y1, y)];
    const margin = 0.03 * Math.max(x1 - x0, y1 - y0, 1e-6);
    return [x0 - margin, y0 - margin, x1 + margin, y1 + margin];
  }

  /** The bounds that hold all of some maps. */
  function frameOf(grids) {
    const all = grids.map((grid) => bounds(grid, []));
    return all.length ? [0, 1, 2, 3].map((k) => Math[k < 2 ? "min" : "max"](...all.map((of) => of[k]))) : null;
  }

  /** What was drawn last on each canvas below the mark, so that a mark that moves costs one copy. */
  const drawn = new WeakMap();

  /**
   * Draws a map with its axes and its bar; returns how places on the page and on the part belong together. What has the
   * same `of` is the same picture below the mark.
   */
  function draw(canvas, { of, grid, limit, colours, dots, path, mark, missing, most, frame, isPinned, hasBar = Boolean(grid) }) {
    const isEmpty = !grid && !(dots && dots.length);
    const [x0, y0, x1, y1] = isEmpty ? [0, 0, 1.6, 1] : frame || bounds(grid, (dots || []).map((dot) => dot.at));
    const [left, right, top, bottom] = [46, hasBar ? 84 : 12, 8, 38];
    // The canvas is as high as the part needs at this width, but not higher than the screen allows.
    const wanted = ((canvas.clientWidth - left - right) * (y1 - y0)) / (x1 - x0) + top + bottom;
    if (most) canvas.style.height = `${Math.round(Math.min(Math.max(wanted, 200), most))}px`;
    const { context, width, height, ink, quiet, ground } = prepared(canvas);
    context.fillStyle = ground;
    context.fillRect(0, 0, width, height);
    if (isEmpty) {
      [context.fillStyle, context.textAlign] = [quiet, "center"];
      context.fillText(missing || "", width / 2, height / 2);
      return null;
    }
    const known = drawn.get(canvas);
    const scale = Math.min((width - left - right) / (x1 - x0), (height - top - bottom) / (y1 - y0));
    const [w, h] = [scale * (x1 - x0), scale * (y1 - y0)];
    const offset = left + Math.max(0, (width - left - right - w) / 2);
    const view = {
      limit,
      toPage: (x, y) => [offset + (x - x0) * scale, top + h - (y - y0) * scale],
      toPart: (px, py) => [x0 + (px - offset) / scale, y0 + (top + h - py) / scale],
    };
    const key = [width, height, window.devicePixelRatio, ink, ground, limit, x0, y0, x1, y1].join();
    if (of && known && known.of === of && known.key === key) {
      context.drawImage(known.image, 0, 0, width, height);
      if (mark) cross(context, known.view, mark, { isPinned, offset, top, w, h, ink, ground });
      return known.view;
    }
    context.save();
    context.beginPath();
    context.rect(offset, top, w, h);
    context.clip();
    if (grid) {
      context.imageSmoothingQuality = "high";
      const [gx0, gy0, gx1, gy1] = bounds(grid, []);
      const [[px, py], [qx, qy]] = [view.toPage(gx0, gy1), view.toPage(gx1, gy0)];
      context.drawImage(picture(grid, limit, colours), px, py, qx - px, qy - py);
    }
    if (dots && dots.length > MOST_DISCS) blocks(context, view, dots, [offset, top, w, h]);
    else discs(context, view, dots || [], { ground, ink, quiet });
    if (path) wheelPath(context, view, path, { quiet, ground, area: [offset, top, w, h], isOver: Boolean(grid) });
    if (grid && grid.low < 0) marks(context, view, extremes(grid), { offset, w, ink, ground });
    context.restore();
    [context.strokeStyle, context.lineWidth] = [ink, 1];
    context.strokeRect(offset, top, w, h);
    axes(context, view, { x0, y0, x1, y1, offset, top, w, h, ink });
    if (hasBar) bar(context, { limit, low: grid ? grid.low : -1, colours, x: offset + w + 14, top, h, ink });
    if (of) {
      const image = document.createElement("canvas");
      [image.width, image.height] = [canvas.width, canvas.height];
      image.getContext("2d").drawImage(canvas, 0, 0);
      drawn.set(canvas, { of, key, image, view });
    }
    if (mark) cross(context, view, mark, { isPinned, offset, top, w, h, ink, ground });
    return view;
  }

  /** The mark of a place, and the two sections through it where somebody put it. */
  function cross(context, view, mark, { isPinned, offset, top, w, h, ink, ground }) {
    const [px, py] = view.toPage(...mark);
    if (px < offset || px > offset + w || py < top || py > top + h) return;
    if (isPinned) {
      const style = getComputedStyle(document.documentElement);
      [[offset, py, offset + w, py], [px, top, px, top + h]].forEach(([ax, ay, bx, by], k) => {
        [context.strokeStyle, context.lineWidth] = [style.getPropertyValue(["--pv", "--rms"][k]).trim(), 1.4];
        context.beginPath();
        context.moveTo(ax, ay);
        context.lineTo(bx, by);
        context.stroke();
      });
    }
    for (const [colour, thick] of [[ground, 3], [ink, 1]]) {
      [context.strokeStyle, context.lineWidth] = [colour, thick];
      context.beginPath();
      context.moveTo(px - 9, py);
      context.lineTo(px + 9, py);
      context.moveTo(px, py - 9);
      context.lineTo(px, py + 9);
      context.stroke();
    }
  }

  /** How much of a path is drawn behind the wheel over a map, so that the map is seen. */
  const TRAIL_SHARE = 0.02;

  /**
   * The path of the wheel: what is ground in the colour of what is on, the rest quiet, and the wheel where it is. Over a
   * map only the last tracks are drawn.
   */
  function wheelPath(context, view, { points, share }, { quiet, ground, area: [left, top, w, h], isOver }) {
    const accent = getComputedStyle(document.documentElement).getPropertyValue("--accent").trim();
    const at = placeOnPath(points, share);
    const lines = (from, to, colour, alpha) => {
      [context.strokeStyle, context.lineWidth, context.globalAlpha] = [colour, 1, alpha];
      context.beginPath();
      let isDown = false;
      for (let k = from; k < to; k += 3) {
        if (Number.isNaN(points[k])) isDown = false;
        else if (isDown) context.lineTo(...view.toPage(points[k], points[k + 1]));
        else [isDown] = [true, context.moveTo(...view.toPage(points[k], points[k + 1]))];
      }
      if (at && to === at.index && isDown) context.lineTo(...view.toPage(...at.place));
      context.stroke();
      context.globalAlpha = 1;
    };
    if (!isOver) lines(at ? Math.max(at.index - 3, 0) : 0, points.length, quiet, 0.2);
    if (!at) return;
    const trail = isOver ? placeOnPath(points, share - TRAIL_SHARE) : null;
    lines(trail ? Math.max(trail.index - 3, 0) : 0, at.index, accent, isOver ? 0.8 : 0.45);
    const [qx, qy] = view.toPage(...at.place);
    // In its run-up the wheel is beside the part.
    const [px, py] = [Math.min(Math.max(qx, left), left + w), Math.min(Math.max(qy, top), top + h)];
    for (const [colour, radius] of [[ground, 9], [accent, 7]]) {
      context.fillStyle = colour;
      context.beginPath();
      context.arc(px, py, radius, 0, 7);
      context.fill();
    }
  }

  /** The place at a share of a path, and the index of the point after it; null before the path begins. */
  function placeOnPath(points, share) {
    let [low, high] = [0, points.length / 3];
    const shareAt = (k) => {
      let j = k;
      while (j < points.length / 3 && Number.isNaN(points[3 * j + 2])) j += 1;
      return j < points.length / 3 ? points[3 * j + 2] : Infinity;
    };
    while (low < high) {
      const middle = (low + high) >> 1;
      if (shareAt(middle) < share) low = middle + 1;
      else high = middle;
    }
    while (low < points.length / 3 && Number.isNaN(points[3 * low])) low += 1;
    if (low >= points.length / 3) low = points.length / 3 - 1;
    const [x, y, end] = points.subarray(3 * low, 3 * low + 3);
    const [u, v, begin] = low > 0 ? points.subarray(3 * low - 3, 3 * low) : [NaN, NaN, NaN];
    if (Number.isNaN(u) || !(end > begin)) return Number.isNaN(x) ? null : { place: [x, y], index: 3 * low };
    const part = Math.min(Math.max((share - begin) / (end - begin), 0), 1);
    return { place: [u + part * (x - u), v + part * (y - v)], index: 3 * low };
  }

  /** The lowest and the highest value, each with a cross and its number. */
  function marks(context, view, found, { offset, w, ink, ground }) {
    for (const { value, at } of found) {
      const [px, py] = view.toPage(...at);
      const text = `${value < 0 ? "−" : "+"}${local(Math.abs(value), 2)}`;
      const isRight = px > offset + w - 60;
      [context.textAlign, context.lineJoin] = [isRight ? "right" : "left", "round"];
      for (const [colour, thick] of [[ground, 4], [ink, 1.5]]) {
        [context.strokeStyle, context.lineWidth] = [colour, thick];
        context.beginPath();
        for (const [dx, dy] of [[4, 4], [4, -4]]) {
          context.moveTo(px - dx, py - dy);
          context.lineTo(px + dx, py + dy);
        }
        context.stroke();
        if (colour === ground) context.strokeText(text, px + (isRight ? -8 : 8), py + 4);
      }
      context.fillStyle = ink;
      context.fillText(text, px + (isRight ? -8 : 8), py + 4);
    }
    context.textAlign = "left";
  }

  /** Points as discs; those of no colour are hollow. */
  function discs(context, view, dots, { ground, ink, quiet }) {
    for (const { at, size, rgb, pitch } of dots) {
      const [px, py] = view.toPage(...at);
      if (pitch) {
        // A place that stands for its surroundings: so the map grows while it is measured.
        const [qx] = view.toPage(at[0] + pitch, at[1]);
        const side = Math.max(qx - px, 2 * size);
        context.fillStyle = `rgb(${rgb})`;
        context.fillRect(px - side / 2, py - side / 2, side + 0.5, side + 0.5);
        continue;
      }
      context.beginPath();
      context.arc(px, py, size, 0, 7);
      [context.fillStyle, context.strokeStyle] = [rgb ? `rgb(${rgb})` : ground, rgb ? ink : quiet];
      if (rgb) context.fill();
      else context.stroke();
    }
  }

  /** Points as blocks of pixels: tens of thousands are there at once. */
  function blocks(context, view, dots, [left, top, w, h]) {
    const fine = window.devicePixelRatio || 1;
    const [wide, high] = [w, h].map((size) => Math.max(1, Math.round(size * fine)));
    const image = new ImageData(wide, high);
    const pixels = new Uint32Array(image.data.buffer);
    for (const { at, size, rgb, pitch } of dots) {
      const [px, py] = view.toPage(...at);
      const grown = pitch ? Math.ceil((view.toPage(at[0] + pitch, at[1])[0] - px) * fine) : 0;
      const side = Math.max(1, grown, Math.round((rgb ? 1.2 : 0.6) * size * fine));
      const [column, row] = [(px - left) * fine, (py - top) * fine].map((middle) => Math.round(middle - side / 2));
      // Alpha, blue, green, red: as the bytes of a pixel lie on every machine that browsers run on.
      const colour = rgb ? (0xff000000 | (rgb[2] << 16) | (rgb[1] << 8) | rgb[0]) >>> 0 : 0xff909090;
      for (let y = Math.max(row, 0); y < Math.min(row + side, high); y += 1) {
        for (let x = Math.max(column, 0); x < Math.min(column + side, wide); x += 1) pixels[y * wide + x] = colour;
      }
    }
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [wide, high];
    canvas.getContext("2d").putImageData(image, 0, 0);
    context.drawImage(canvas, left, top, w, h);
  }

  function axes(context, view, { x0, y0, x1, y1, offset, top, w, h, ink }) {
    context.fillStyle = ink;
    context.textAlign = "center";
    for (const [x, text] of ticks(x0, x1)) {
      const [px] = view.toPage(x, y0);
      context.fillRect(px, top + h, 1, 4);
      context.fillText(text, px, top + h + 16);
    }
    context.textAlign = "right";
    for (const [y, text] of ticks(y0, y1)) {
      const [, py] = view.toPage(x0, y);
      context.fillRect(offset - 4, py, 4, 1);
      context.fillText(text, offset - 7, py + 4);
    }
    context.textAlign = "right";
    context.fillText("mm", offset + w, top + h + 31);
    context.textAlign = "left";
  }

  function bar(context, { limit, low, colours, x, top, h, ink }) {
    for (let k = 0; k < 255; k += 1) {
      context.fillStyle = `rgb(${colours[3 * k]},${colours[3 * k + 1]},${colours[3 * k + 2]})`;
      context.fillRect(x, top + h * (1 - (k + 1) / 255), 14, h / 255 + 1);
    }
    context.strokeStyle = ink;
    context.strokeRect(x, top, 14, h);
    context.fillStyle = ink;
    for (const [value, text] of ticks(low * limit, limit)) {
      context.fillText(text, x + 19, top + h * (1 - (value / limit - low) / (1 - low)) + 4);
    }
    context.fillText("µm", x, top + h + 16);
  }

  /** Draws how many nodes have which value. */
  function histogram(canvas, { values, low }, limit, colours) {
    const { context, width, height, ink } = prepared(canvas);
    const bins = new Array(51).fill(0);
    for (const value of values) {
      if (!Number.isNaN(value)) bins[Math.min(50, Math.floor((51 * level(value, limit, low)) / 255))] += 1;
    }
    const most = Math.max(...bins, 1);
    const [left, wide, high] = [46, width - 80, height - 20];
    bins.forEach((count, k) => {
      const at = 3 * Math.round(k * 5.08);
      context.fillStyle = `rgb(${colours[at]},${colours[at + 1]},${colours[at + 2]})`;
      const bar = (high * count) / most;
      context.fillRect(left + (wide * k) / 51, high - bar, wide / 51 - 1, bar);
      context.strokeStyle = ink;
      context.lineWidth = 0.4;
      if (count) context.strokeRect(left + (wide * k) / 51, high - bar, wide / 51 - 1, bar);
    });
    context.fillStyle = ink;
    context.fillRect(left, high, wide, 1);
    context.textAlign = "center";
    for (const [value, text] of ticks(low * limit, limit)) {
      context.fillText(text, left + (wide * (value / limit - low)) / (1 - low), height - 5);
    }
    context.textAlign = "left";
    context.fillText("µm", left + wide + 8, height - 5);
  }

  /** The values of a map along x and along y through a place: [place along the axis, value]. */
  function sectionsAt(grid, [x, y]) {
    const along = (count, at) => Array.from({ length: count }, (_, k) => at(k));
    return [
      along(grid.columns, (k) => grid.firstX + k * grid.stepX).map((at) => [at, valueAt(grid, at, y)]),
      along(grid.rows, (k) => grid.firstY + k * grid.stepY).map((at) => [at, valueAt(grid, x, at)]),
    ];
  }

  /** Draws the two sections of a map through a place, each in its colour, over one axis of places. */
  function sections(canvas, grid, place, limit) {
    const { context, width, height, ink, quiet } = prepared(canvas);
    const style = getComputedStyle(document.documentElement);
    const lines = sectionsAt(grid, place);
    const known = lines.flat().filter(([, value]) => !Number.isNaN(value));
    if (!known.length) return;
    const [x0, x1] = [Math.min(...known.map(([at]) => at)), Math.max(...known.map(([at]) => at))];
    const [left, wide, top, high] = [46, width - 80, 6, height - 28];
    const low = grid.low < 0 ? -limit : 0;
    const toX = (at) => left + (wide * (at - x0)) / (x1 - x0 || 1);
    const toY = (value) => top + (high * (limit - Math.min(Math.max(value, low), limit))) / (limit - low);
    context.fillStyle = quiet;
    context.textAlign = "right";
    for (const [value, text] of ticks(low, limit)) {
      if (toY(value) > top + 4 && toY(value) < top + high - 2) context.fillText(text, left - 6, toY(value) + 4);
    }
    context.textAlign = "center";
    for (const [at, text] of ticks(x0, x1)) context.fillText(text, toX(at), height - 6);
    context.textAlign = "left";
    context.fillText("mm", left + wide + 8, height - 6);
    context.fillRect(left, toY(0), wide, 1);
    lines.forEach((line, k) => {
      context.strokeStyle = style.getPropertyValue(["--pv", "--rms"][k]).trim();
      context.lineWidth = 1.6;
      context.beginPath();
      let isDown = false;
      for (const [at, value] of line) {
        if (Number.isNaN(value)) isDown = false;
        else if (isDown) context.lineTo(toX(at), toY(value));
        else [isDown] = [true, context.moveTo(toX(at), toY(value))];
      }
      context.stroke();
      context.fillStyle = context.strokeStyle;
      context.fillText(["x", "y"][k], left + wide + 8, top + 12 + 16 * k);
    });
    context.fillStyle = ink;
  }

  return { bounds, sections, readGrid, readColours, statistics, roundLimit, levelled, difference, frameOf, draw, histogram, level };
})();
