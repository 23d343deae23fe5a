/** Files that the page gives out. */

export function saveFile(name: string, content: Blob): void {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(content);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** Save a drawing as a PNG, three pixels for each of its units. */
export async function savePlotPicture(name: string, svg: string): Promise<void> {
  const size = /viewBox="0 0 (\d+) (\d+)"/.exec(svg);
  const width = Number(size?.[1] ?? 640) * 3, height = Number(size?.[2] ?? 480) * 3;
  const address = URL.createObjectURL(new Blob([svg], { type: "image/svg+xml" }));
  try {
    const image = new Image(width, height);
    image.src = address;
    await image.decode();
    const canvas = document.createElement("canvas");
    canvas.width = width;
    canvas.height = height;
    canvas.getContext("2d")?.drawImage(image, 0, 0, width, height);
    canvas.toBlob((blob) => blob && saveFile(name, blob), "image/png");
  } finally {
    URL.revokeObjectURL(address);
  }
}
