// Before anything is drawn: light or dark, as chosen here or as the system has it.
document.documentElement.dataset.theme =
  localStorage.getItem("nisus.theme") ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
// Rerun's and Viser's pages take their theme when they start.
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => localStorage.getItem("nisus.theme") ?? location.reload());
