// Begins the viewer: the first picture as soon as it can be there, then everything else (controls.js).
import { context, firstFile } from "./context.js";
import { firstPicture, prepare } from "./first.js";
import { Stage } from "./stage.js";
import { Surface } from "./surface.js";

const $ = (id) => document.getElementById(id);

function stop(text) {
  $("cover").classList.remove("gone");
  $("cover").classList.add("fault");
  $("cover-text").textContent = text;
  document.documentElement.dataset.state = "fault";
}

async function main() {
  if (!context) {
    stop("This page draws with WebGL 2, which this browser does not offer. Try a current Firefox, Chrome, Edge or Safari, and see that hardware acceleration is on.");
    return;
  }
  $("canvas").addEventListener("webglcontextlost", () => stop("The graphics card gave up (its context was lost). Load the page again."));
  const surface = new Surface(), stage = new Stage($("canvas"), context, $("view"));
  stage.frame();
  let first = null;
  try {
    prepare(stage, surface);
    first = await firstPicture(await firstFile, stage, surface);
    stage.run();
    $("cover").classList.add("gone");
    await stage.painted();
    performance.mark("first picture");
    document.documentElement.dataset.state = "ready";
    $("state").textContent = "The full picture is being prepared …";
  } catch (error) {
    console.warn(`There is no first picture: ${error.message}`);
  }
  const { control } = await import("./controls.js");
  await control(stage, surface, first);
}

main().catch((error) => {
  console.error(error);
  stop(`The avatar cannot be shown: ${error.message}`);
});
