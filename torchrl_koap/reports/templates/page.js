// tables: a click on a heading sorts, another one turns the order round
document.querySelectorAll("table.sortable th").forEach((head) => head.addEventListener("click", () => {
  const body = head.closest("table").tBodies[0], column = head.cellIndex;
  const down = head.getAttribute("aria-sort") === "ascending", turn = down ? -1 : 1;
  const value = (row) => row.cells[column].textContent.trim();
  const size = (text) => parseFloat(text.replace(/,/g, ""));
  const order = (a, b) => {
    const [x, y] = [size(value(a)), size(value(b))];
    return turn * (isNaN(x) || isNaN(y) ? value(a).localeCompare(value(b)) : x - y);
  };
  [...body.rows].sort(order).forEach((row) => body.appendChild(row));
  head.parentNode.querySelectorAll("th").forEach((other) => other.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
}));
// films: still at their first picture until they are clicked; another click stops them
document.querySelectorAll("a.film").forEach((link) => {
  const image = link.querySelector("img"), still = document.createElement("canvas");
  const stop = () => {
    still.width = image.naturalWidth; still.height = image.naturalHeight;
    still.getContext("2d").drawImage(image, 0, 0);
    link.classList.add("still");
  };
  link.appendChild(still);
  if (image.complete && image.naturalWidth) stop(); else image.addEventListener("load", stop, { once: true });
  link.addEventListener("click", (event) => {
    event.preventDefault();
    if (link.classList.contains("still")) { link.classList.remove("still"); image.src = image.src; } else stop();
  });
});
