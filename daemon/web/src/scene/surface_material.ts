import { DoubleSide, GLSL3, RawShaderMaterial, Vector3, type Texture } from "three";
import type { Scalars } from "../api/mesh_message";

/** How a surface is coloured. */
export const LOOKS = ["textured", "shaded", "wireframe", "skin", "depth", "error", "motion"] as const;
export type Look = (typeof LOOKS)[number];

/** The numbers that a look colours by, all millimetres. */
export function scalarsOf(look: Look): Scalars {
  return look === "depth" || look === "error" || look === "motion" ? look : "none";
}

// Each look is a program of its own that carries only what it needs from vertex to pixel: in software rendering, every
// number carried is paid for by every triangle.
const VERTEX = `
precision highp float;
in vec3 position;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform vec3 originMm, stepMm;
#ifdef TEXTURED
in vec2 uv;
out vec2 textureUv;
#endif
#ifdef LIT
out vec3 eyePosition;
#endif
#ifdef SCALAR
in float scalar;
uniform float scalarScale, scalarStart;
out float value;
#endif
void main() {
  vec3 mm = originMm + stepMm * position;
  vec4 eye = modelViewMatrix * vec4(mm, 1.0);
#ifdef TEXTURED
  textureUv = vec2(uv.x, 1.0 - uv.y);
#endif
#ifdef LIT
  eyePosition = eye.xyz;
#endif
#ifdef SCALAR
  value = clamp(scalarStart + scalarScale * scalar, 0.0, 1.0);
#endif
  gl_Position = projectionMatrix * eye;
}`;

// Viridis as a polynomial (after M. Zucker's fit, 2019, CC0) of S. van der Walt and N. Smith's map (2015, CC0).
const FRAGMENT = `
precision highp float;
uniform bool grey;
out vec4 colour;
#ifdef TEXTURED
in vec2 textureUv;
uniform sampler2D picture;
vec3 shade() {
  return texture(picture, textureUv).rgb;
}
#endif
#ifdef PLAIN
uniform vec3 plainColour;
vec3 shade() {
  return plainColour;
}
#endif
#ifdef LIT
in vec3 eyePosition;
vec3 shade() {
  vec3 normal = normalize(cross(dFdx(eyePosition), dFdy(eyePosition)));
  float facing = abs(normal.z);
  float key = abs(dot(normal, normalize(vec3(0.35, 0.45, 0.82))));
#ifdef SKIN
  vec3 wrapped = (vec3(key) + vec3(0.45, 0.22, 0.15)) / vec3(1.45, 1.22, 1.15);
  return vec3(0.93, 0.72, 0.60) * (0.12 + 0.62 * wrapped + 0.26 * facing);
#else
  return vec3(0.80, 0.82, 0.85) * (0.18 + 0.30 * facing + 0.52 * key);
#endif
}
#endif
#ifdef SCALAR
in float value;
vec3 shade() {
  const vec3 c0 = vec3(0.2777273, 0.0054074, 0.3340998);
  const vec3 c1 = vec3(0.1050930, 1.4046135, 1.3845901);
  const vec3 c2 = vec3(-0.3308618, 0.2148476, 0.0950952);
  const vec3 c3 = vec3(-4.6342305, -5.7991010, -19.3324410);
  const vec3 c4 = vec3(6.2282699, 14.1799334, 56.6905526);
  const vec3 c5 = vec3(4.7763850, -13.7451454, -65.3530326);
  const vec3 c6 = vec3(-5.4354559, 4.6458526, 26.3124352);
  float t = value;
  return c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c6)))));
}
#endif
void main() {
  vec3 c = shade();
  if (grey) c = vec3(dot(c, vec3(0.299, 0.587, 0.114)));
  colour = vec4(c, 1.0);
}`;

/** What the programs of the looks have; a surface behind wires is drawn in the ground's colour. */
const DEFINES: Record<Look, Record<string, string>> = {
  textured: { TEXTURED: "" },
  shaded: { LIT: "" },
  wireframe: { PLAIN: "" },
  skin: { LIT: "", SKIN: "" },
  depth: { SCALAR: "" },
  error: { SCALAR: "" },
  motion: { SCALAR: "" },
};

/** Material of a surface whose positions come as 16-bit steps: they become millimetres in the vertex shader. */
export class SurfaceMaterial extends RawShaderMaterial {
  constructor(readonly wires = false) {
    super({
      glslVersion: GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      side: DoubleSide,
      polygonOffset: !wires,
      polygonOffsetFactor: 1,
      polygonOffsetUnits: 1,
      defines: wires ? DEFINES.wireframe : DEFINES.shaded,
      uniforms: {
        originMm: { value: new Vector3() },
        stepMm: { value: new Vector3() },
        picture: { value: null },
        scalarScale: { value: 1 },
        scalarStart: { value: 0 },
        grey: { value: false },
        plainColour: { value: new Vector3() },
      },
    });
  }

  setGrid(originMm: [number, number, number], stepMm: [number, number, number]): void {
    (this.uniforms["originMm"]!.value as Vector3).fromArray(originMm);
    (this.uniforms["stepMm"]!.value as Vector3).fromArray(stepMm);
  }

  setLook(look: Look): void {
    if (this.wires || this.defines === DEFINES[look]) return;
    this.defines = DEFINES[look];
    this.needsUpdate = true;
  }

  setPicture(picture: Texture | null): void {
    this.set("picture", picture);
  }

  /** Scalars, 0 to 1 in the buffer, become colours: the first one's place among the colours, and how far all span. */
  setScalarPlaces(start: number, scale: number): void {
    this.set("scalarStart", start);
    this.set("scalarScale", scale);
  }

  /** Without colours, for red-cyan glasses: colours would differ between the eyes. */
  setGrey(grey: boolean): void {
    this.set("grey", grey);
  }

  /** Colour of wires, or of the surface that hides those behind it; 0 to 1 each. */
  setPlainColour(red: number, green: number, blue: number): void {
    (this.uniforms["plainColour"]!.value as Vector3).set(red, green, blue);
  }

  private set(name: string, value: unknown): void {
    this.uniforms[name]!.value = value;
    this.uniformsNeedUpdate = true;
  }
}
