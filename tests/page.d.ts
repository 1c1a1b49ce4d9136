/** What browsers have, and TypeScript 4 does not know. */
declare class DecompressionStream implements GenericTransformStream {
  constructor(format: "deflate");
  readonly readable: ReadableStream;
  readonly writable: WritableStream;
}

/** Of plotly, what plots call. */
declare const Plotly: {
  newPlot(element: HTMLElement, data: object[], layout: object, config: object): Promise<unknown>;
  react(element: HTMLElement, data: object[], layout: object, config: object): Promise<unknown>;
  restyle(element: HTMLElement, changed: object): Promise<unknown>;
};
