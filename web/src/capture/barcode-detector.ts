/** What finds barcodes in a picture: the browser's own detector, or ZXing's, loaded where a browser (Safari) has none. */

export interface Detector {
  detect(source: HTMLVideoElement): Promise<{ rawValue: string }[]>;
}
type DetectorClass = new () => Detector;

/** Longest side of the picture that is searched: enough for a label that fills a third of it, and quick on a tablet. */
const LONGEST = 960;

export async function barcodeDetector(): Promise<Detector> {
  const own = (globalThis as { BarcodeDetector?: DetectorClass }).BarcodeDetector;
  return own ? new own() : zxingDetector();
}

async function zxingDetector(): Promise<Detector> {
  const zxing = await import("./zxing");
  const reader = new zxing.MultiFormatReader();
  reader.setHints(
    new Map<number, unknown>([
      [zxing.DecodeHintType.TRY_HARDER, true],
      [
        zxing.DecodeHintType.POSSIBLE_FORMATS,
        [zxing.BarcodeFormat.CODE_128, zxing.BarcodeFormat.CODE_39, zxing.BarcodeFormat.DATA_MATRIX, zxing.BarcodeFormat.QR_CODE],
      ],
    ]),
  );
  const canvas = document.createElement("canvas");
  return {
    detect(source) {
      const scale = Math.min(1, LONGEST / Math.max(source.videoWidth, source.videoHeight, 1));
      canvas.width = Math.round(source.videoWidth * scale);
      canvas.height = Math.round(source.videoHeight * scale);
      if (!canvas.width || !canvas.height) return Promise.resolve([]);
      const drawing = canvas.getContext("2d", { willReadFrequently: true });
      if (!drawing) return Promise.resolve([]);
      drawing.drawImage(source, 0, 0, canvas.width, canvas.height);
      const grey = greyOf(drawing.getImageData(0, 0, canvas.width, canvas.height).data);
      const picture = new zxing.RGBLuminanceSource(grey, canvas.width, canvas.height);
      try {
        const bitmap = new zxing.BinaryBitmap(new zxing.HybridBinarizer(picture));
        return Promise.resolve([{ rawValue: reader.decodeWithState(bitmap).getText() }]);
      } catch {
        // No code, or one that does not read: the next picture may show it better.
        return Promise.resolve([]);
      }
    },
  };
}

function greyOf(rgba: Uint8ClampedArray): Uint8ClampedArray {
  const grey = new Uint8ClampedArray(rgba.length / 4);
  for (let i = 0; i < grey.length; i++) {
    grey[i] = ((rgba[4 * i] ?? 0) + 2 * (rgba[4 * i + 1] ?? 0) + (rgba[4 * i + 2] ?? 0)) / 4;
  }
  return grey;
}
