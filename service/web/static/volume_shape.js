// The map as lines and triangles: commanded grid, deformed grid, arrows, a slice. Unknown errors are grey and have no arrow.

const STEPS = 5;

export function colourOf(map, k, style) {
  if (!map.significant[k]) return style.grey;
  return style.steps[Math.min(STEPS - 1, Math.floor((STEPS * map.length[k]) / style.top))];
}

function nodes([xs, ys, zs]) {
  const out = [];
  for (const x of xs) for (const y of ys) for (const z of zs) out.push([x, y, z]);
  return out;
}

// Positions in a cube of side 1 around the middle of the strokes. Texts of positions (`axes`, `at`), `deviation`, `length` and `expanded` are in
// the reader's units, positions in inches with four decimals; `move` converts a deviation to the cube.
export function prepared(answer, unit) {
  const mm = [answer.x_mm, answer.y_mm, answer.z_mm];
  const n = answer.nodes;
  const span = Math.max(...mm.map((a) => a[n - 1] - a[0]));
  const middle = mm.map((a) => (a[0] + a[n - 1]) / 2);
  const axes = mm.map((a) => a.map((v) => String(Number((v / unit.mm).toFixed(unit.mm === 1 ? 3 : 4)))));
  const places = nodes(mm).map((p) => p.map((v, i) => (v - middle[i]) / span));
  const [deviation, expanded] = [answer.deviation_um, answer.expanded_um].map((rows) => rows.map((row) => row.map((v) => v / unit.um)));
  const length = deviation.map((d) => Math.hypot(...d));
  const box = mm.map((a) => (a[n - 1] - a[0]) / span / 2);
  return { n, axes, at: nodes(axes), places, length, box, deviation, expanded, significant: answer.significant, move: (unit.um * 1e-3) / span };
}

export function moved(map, k, factor) {
  return map.places[k].map((v, i) => v + map.deviation[k][i] * factor * map.move);
}

const STRIDES = (n) => [n * n, n, 1];

function inCut(map, k, cut) {
  return !cut || Math.floor(k / STRIDES(map.n)[cut.axis]) % map.n === cut.level;
}

function push(out, place, paint) {
  out.push(place[0], place[1], place[2], paint[0], paint[1], paint[2], paint[3]);
}

function edges(map, cut, each) {
  const strides = STRIDES(map.n);
  for (let k = 0; k < map.places.length; k += 1) {
    if (!inCut(map, k, cut)) continue;
    strides.forEach((stride, axis) => {
      if (Math.floor(k / stride) % map.n < map.n - 1 && inCut(map, k + stride, cut)) each(k, k + stride, axis);
    });
  }
}

function arrow(lines, corners, from, to, paint) {
  const way = to.map((v, i) => v - from[i]);
  const long = Math.hypot(...way);
  if (long < 1e-4) return;
  const unit = way.map((v) => v / long);
  const head = Math.min(0.03, 0.4 * long);
  const side = Math.abs(unit[2]) < 0.9 ? [unit[1], -unit[0], 0] : [0, unit[2], -unit[1]];
  const size = Math.hypot(...side);
  const first = side.map((v) => (v / size) * head * 0.4);
  const second = [unit[1] * first[2] - unit[2] * first[1], unit[2] * first[0] - unit[0] * first[2], unit[0] * first[1] - unit[1] * first[0]];
  const base = to.map((v, i) => v - unit[i] * head);
  push(lines, from, paint);
  push(lines, base, paint);
  for (const wing of [first, second]) {
    push(corners, to, paint);
    push(corners, base.map((v, i) => v + wing[i]), paint);
    push(corners, base.map((v, i) => v - wing[i]), paint);
  }
}

function sheet(map, cut, corners, style) {
  const strides = STRIDES(map.n).filter((_, axis) => axis !== cut.axis);
  const across = [0, 1, 2].filter((axis) => axis !== cut.axis);
  for (let k = 0; k < map.places.length; k += 1) {
    if (!inCut(map, k, cut) || across.some((axis, i) => Math.floor(k / strides[i]) % map.n === map.n - 1)) continue;
    const [a, b, c, d] = [k, k + strides[0], k + strides[0] + strides[1], k + strides[1]];
    for (const one of [a, b, c, a, c, d]) push(corners, map.places[one], [...colourOf(map, one, style).slice(0, 3), 0.35]);
  }
}

function mark(lines, place, paint) {
  for (const axis of [0, 1, 2]) {
    for (const sign of [-1, 1]) push(lines, place.map((v, i) => (i === axis ? v + sign * 0.03 : v)), paint);
  }
}

export function shape(map, view, style) {
  const [lines, corners] = [[], []];
  if (view.grid) {
    edges(map, view.cut, (a, b) => {
      push(lines, map.places[a], style.nominal);
      push(lines, map.places[b], style.nominal);
      for (const [k, other] of [[a, b], [b, a]]) {
        push(lines, moved(map, k, view.factor), map.significant[other] ? colourOf(map, k, style) : style.grey);
      }
    });
  }
  if (view.arrows) {
    map.places.forEach((place, k) => {
      if (inCut(map, k, view.cut) && map.significant[k]) arrow(lines, corners, place, moved(map, k, view.factor), colourOf(map, k, style));
    });
  }
  if (view.cut) sheet(map, view.cut, corners, style);
  mark(lines, map.places[view.node], style.ink);
  return [lines, corners];
}
