// Light or dark: as the system, unless the user has chosen. It runs before the page is drawn, so that nothing flashes.
"use strict";
(() => {
  const KEY = "sinew-theme";
  const stored = () => {
    try {
      return localStorage.getItem(KEY) || "system";
    } catch {
      return "system"; // The browser keeps nothing for this page.
    }
  };
  const apply = (theme) => {
    if (theme === "system") {
      delete document.documentElement.dataset.theme;
    } else {
      document.documentElement.dataset.theme = theme;
    }
    document.dispatchEvent(new Event("theme"));
  };
  apply(stored());
  document.addEventListener("DOMContentLoaded", () => {
    const select = document.getElementById("theme");
    select.value = stored();
    select.addEventListener("change", () => {
      try {
        localStorage.setItem(KEY, select.value);
      } catch {
        // The choice lasts until the page is closed.
      }
      apply(select.value);
    });
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => apply(stored()));
})();
