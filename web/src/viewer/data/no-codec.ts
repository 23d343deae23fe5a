/** Stands for the codecs of numcodecs in the build: no cloud uses them, and the pages' security policy forbids them. */
export default {
  fromConfig: (): never => {
    throw new Error("this codec is not built in");
  },
};
