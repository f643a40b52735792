// Keeps the page's own files, so that it works without a network. The build fills in both lists.
const prefix = `deepdetect ${self.registration.scope} `; // caches are those of the whole host
const version = prefix + "VERSION";
const files = ["FILES"];

self.addEventListener("install", (event) => {
  // Asked of the server again: what the browser has kept of an older version would stay for good.
  const requests = files.map((file) => new Request(file, { cache: "no-cache" }));
  event.waitUntil(caches.open(version).then((cache) => cache.addAll(requests))
    .then(() => self.skipWaiting()));
});

self.addEventListener("activate", (event) => {
  event.waitUntil(caches.keys()
    .then((names) => Promise.all(names.filter((name) => name.startsWith(prefix) && name !== version)
      .map((name) => caches.delete(name))))
    .then(() => self.clients.claim()));
});

self.addEventListener("fetch", (event) => {
  if (event.request.method !== "GET") return;
  event.respondWith(caches.match(event.request, { cacheName: version, ignoreSearch: true })
    .then((kept) => kept ?? fetch(event.request)));
});
