// What the theme makes lacks two things for screen readers and keyboards: names that tell its menus apart, and tables
// that can be focused where they scroll.
const repair = () => {
  document.querySelectorAll("nav.md-nav, nav.md-code__nav").forEach((menu, i) => {
    const title = menu.matches(".md-code__nav") ? "Code" : menu.querySelector(".md-nav__title")?.textContent.trim();
    const label = `${title || "Menu"} ${i + 1}`;
    if (menu.ariaLabel === label) return; // no endless loop of repairs
    menu.removeAttribute("aria-labelledby");
    menu.ariaLabel = label;
  });
  for (const table of document.querySelectorAll(".md-typeset__scrollwrap:not([tabindex])")) table.tabIndex = 0;
};
new MutationObserver(repair).observe(document.body, { childList: true, subtree: true });
repair();
