// Typesets the equations that pymdownx.arithmatex has marked; KaTeX and its fonts lie beside this file.
document.addEventListener("DOMContentLoaded", () => {
  for (const element of document.querySelectorAll(".arithmatex")) {
    const source = element.textContent.trim(); // \(…\) in a line of text, \[…\] on a line of its own
    katex.render(source.slice(2, -2), element, { displayMode: source.startsWith("\\["), throwOnError: false });
  }
});
