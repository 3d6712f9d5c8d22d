// What scrolls sideways (wide tables, code) can be reached and scrolled with the keyboard, and what readers of the screen list has a name.
const improve = () => {
  for (const box of document.querySelectorAll(".md-typeset__scrollwrap, .md-typeset pre, .md-typeset pre > code, .md-typeset__table")) {
    if (box.scrollWidth > box.clientWidth) box.tabIndex = 0;
    else if (box.getAttribute("tabindex") === "0") box.removeAttribute("tabindex");
  }
  document.querySelectorAll(".md-code__nav").forEach((nav, i) => nav.setAttribute("aria-label", `code block ${i + 1}`));
  document.querySelector(".md-search")?.setAttribute("aria-label", "search");
};
addEventListener("load", () => setTimeout(improve, 100));
addEventListener("resize", improve);
new MutationObserver(improve).observe(document.documentElement, { childList: true, subtree: true });
