import { Matrix4, type PerspectiveCamera, type Scene, type WebGLRenderer } from "three";
import { FIELD_OF_VIEW_DEG, type Orbit } from "./orbit";

export const STEREO_MODES = ["mono", "anaglyph", "side_by_side"] as const;
export type StereoMode = (typeof STEREO_MODES)[number];

/** Eye distance as a part of the viewing distance: what is at the target has no parallax, comfort is kept at any zoom. */
const EYE_SEPARATION = 1 / 25;
const NEAR = 0.02;
const FAR = 8;

/**
 * Frustum of one eye at the near plane: left, right, top, bottom. Off-axis (P. Bourke, "Calculating stereo pairs",
 * 1999): both eyes look the same way and share the window at the target's distance, so nothing has vertical parallax.
 */
export function eyeFrustum(aspect: number, distanceMm: number, eyeOffsetMm: number): [number, number, number, number] {
  const near = NEAR * distanceMm;
  const half = near * Math.tan((FIELD_OF_VIEW_DEG * Math.PI) / 360);
  const [right, top] = aspect < 1 ? [half, half / aspect] : [half * aspect, half];
  const shift = (-eyeOffsetMm * near) / distanceMm;
  return [-right + shift, right + shift, top, -top];
}

/** Stands a camera where an orbit says, moved to the right by an eye's offset. */
export function placeCamera(camera: PerspectiveCamera, orbit: Orbit, aspect: number, eyeOffsetMm: number): void {
  const { right, up, back } = orbit.axes();
  const eye = orbit.target.map((t, k) => t + back[k]! * orbit.distanceMm + right[k]! * eyeOffsetMm);
  const [rx, ry, rz] = right as [number, number, number];
  const [ux, uy, uz] = up as [number, number, number];
  const [bx, by, bz] = back as [number, number, number];
  const [ex, ey, ez] = eye as [number, number, number];
  camera.matrixAutoUpdate = false;
  camera.matrix.copy(new Matrix4(rx, ux, bx, ex, ry, uy, by, ey, rz, uz, bz, ez, 0, 0, 0, 1));
  camera.matrixWorldNeedsUpdate = true;
  const [left, rightEdge, top, bottom] = eyeFrustum(aspect, orbit.distanceMm, eyeOffsetMm);
  const [near, far] = [NEAR * orbit.distanceMm, FAR * orbit.distanceMm];
  camera.projectionMatrix.makePerspective(left, rightEdge, top, bottom, near, far);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}

/** Draws a scene for one eye or both, filling `width` by `height` CSS pixels. */
export function renderStereo(
  renderer: WebGLRenderer,
  scene: Scene,
  camera: PerspectiveCamera,
  orbit: Orbit,
  mode: StereoMode,
  [width, height]: [number, number],
): void {
  const half = (EYE_SEPARATION / 2) * orbit.distanceMm;
  const gl = renderer.getContext();
  renderer.setViewport(0, 0, width, height);
  renderer.clear();
  if (mode === "mono") {
    placeCamera(camera, orbit, width / height, 0);
    renderer.render(scene, camera);
    return;
  }
  for (const [eye, offset] of [-half, half].entries()) {
    if (mode === "anaglyph") {
      renderer.clearDepth();
      gl.colorMask(eye === 0, eye === 1, eye === 1, true);
      placeCamera(camera, orbit, width / height, offset);
    } else {
      renderer.setViewport((eye * width) / 2, 0, width / 2, height);
      placeCamera(camera, orbit, width / 2 / height, offset);
    }
    renderer.render(scene, camera);
  }
  gl.colorMask(true, true, true, true);
}
