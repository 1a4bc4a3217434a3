// Links open what they lead to, and paper shows everything.
const folds = () => document.querySelectorAll("details[id]");
const lead = () => { const one = $(decodeURIComponent(location.hash.slice(1))); if (one?.tagName === "DETAILS") { one.open = true; one.scrollIntoView(); } };
addEventListener("hashchange", lead); lead();
addEventListener("beforeprint", () => { for (const one of folds()) one.open = true; });
const seen = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) document.querySelector(`nav a[href="#${target.id}"]`)?.classList.toggle("here", isIntersecting);
}, { rootMargin: "-60px 0px -70% 0px" });
for (const one of document.querySelectorAll("nav ~ [id]")) seen.observe(one);
// a long name may break behind a '_' or a '.'
for (const one of document.querySelectorAll("td.name"))
  if (!one.children.length) one.innerHTML = one.innerHTML.replace(/[_.](?=\w)/g, "$&<wbr>");
