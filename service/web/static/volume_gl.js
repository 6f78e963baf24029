// Draws coloured lines and triangles with WebGL2 in parallel projection. Positions lie in a cube of side 1 around the origin.

const VERTEX = `#version 300 es
in vec3 place; in vec4 paint; uniform mat3 turn; uniform vec2 zoom; out vec4 colour;
void main() { vec3 p = turn * place; gl_Position = vec4(p.x * zoom.x, p.y * zoom.y, p.z * 0.25, 1.0); colour = paint; }`;
const FRAGMENT = `#version 300 es
precision mediump float; in vec4 colour; out vec4 seen; void main() { seen = vec4(colour.rgb * colour.a, colour.a); }`;

export const FLOATS = 7; // of a vertex: place, colour

function compiled(gl, kind, text) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) ?? "shader");
  return shader;
}

// Rows: right, up, and away from the viewer, whose view points down by the pitch; Z of the machine points up.
export function rotation(yaw, pitch) {
  const [c, s, k, h] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return [[c, s, 0], [-s * h, c * h, k], [-s * k, c * k, -h]];
}

export function painter(canvas) {
  const gl = canvas.getContext("webgl2", { antialias: true, premultipliedAlpha: true });
  if (!gl) return null;
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl, gl.VERTEX_SHADER, VERTEX));
  gl.attachShader(program, compiled(gl, gl.FRAGMENT_SHADER, FRAGMENT));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) ?? "program");
  gl.useProgram(program);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  for (const [name, size, from] of [["place", 3, 0], ["paint", 4, 12]]) {
    const at = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, gl.FLOAT, false, FLOATS * 4, from);
  }
  gl.enable(gl.DEPTH_TEST);
  gl.enable(gl.BLEND);
  gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  const turn = gl.getUniformLocation(program, "turn");
  const zoom = gl.getUniformLocation(program, "zoom");
  let lines = 0;
  let corners = 0;
  return {
    fill(lineData, triangleData) {
      lines = lineData.length / FLOATS;
      corners = triangleData.length / FLOATS;
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([...lineData, ...triangleData]), gl.DYNAMIC_DRAW);
    },
    draw(rows, scale) {
      const [width, height] = [canvas.width, canvas.height];
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
      const side = Math.min(width, height);
      gl.uniformMatrix3fv(turn, true, rows.flat());
      gl.uniform2f(zoom, (scale * side) / width, (scale * side) / height);
      gl.drawArrays(gl.LINES, 0, lines);
      gl.drawArrays(gl.TRIANGLES, lines, corners);
    },
  };
}
