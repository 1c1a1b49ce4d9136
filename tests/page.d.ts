/** What browsers have, and TypeScript 4 does not know. */
declare class DecompressionStream implements GenericTransformStream {
  constructor(format: "deflate");
  readonly readable: ReadableStream;
  readonly writable: WritableStream;
}

/** Of plotly, what plots call. */
declare const Plotly: {
  newPlot(place: HTMLElement, data: object[], layout: object, config: object): Promise<unknown>;
  react(place: HTMLElement, data: object[], layout: object, config: object): Promise<unknown>;
  restyle(place: HTMLElement, changed: object): Promise<unknown>;
};
