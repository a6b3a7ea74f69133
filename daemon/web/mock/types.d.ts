declare module "*/face.mjs" {
  export function meshMessage(request: {
    sequence: number;
    seconds: number;
    maxVertices: number;
    scalars: string;
    full: boolean;
  }): Buffer;
}
declare module "*/state.mjs" {
  export class MockState {
    startRecording: (name: string, raw: boolean) => string;
    stopRecording: () => unknown;
    fillDisk: (full: boolean) => void;
    unplug: (out: boolean) => void;
  }
}
declare module "*/server.mjs" {
  export function startMock(options?: { port?: number; token?: string | null }): Promise<{
    state: import("./state.mjs").MockState;
    port: number;
    url: string;
    close: () => Promise<void>;
  }>;
}
