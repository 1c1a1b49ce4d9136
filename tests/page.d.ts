/** What browsers have, and TypeScript 4 does not know. */
declare class DecompressionStream implements GenericTransformStream {
  constructor(format: "deflate");
  readonly readable: ReadableStream;
  readonly writable: WritableStream;
}
