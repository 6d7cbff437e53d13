//! Assets that a browser needs in addition to the pages. They are part of the program.

use axum::extract::Path;
use axum::http::StatusCode;
use axum::http::header::{CACHE_CONTROL, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};

const ASSETS: [(&str, &str, &str); 12] = [
    ("page.css", "text/css; charset=utf-8", include_str!("assets/page.css")),
    ("page.js", "text/javascript; charset=utf-8", include_str!("assets/page.js")),
    ("map.js", "text/javascript; charset=utf-8", include_str!("assets/map.js")),
    ("relief.js", "text/javascript; charset=utf-8", include_str!("assets/relief.js")),
    ("codemirror.js", "text/javascript; charset=utf-8", include_str!("assets/codemirror.js")),
    ("scene.js", "text/javascript; charset=utf-8", include_str!("assets/scene.js")),
    ("workbench.js", "text/javascript; charset=utf-8", include_str!("assets/workbench.js")),
    ("workbench.css", "text/css; charset=utf-8", include_str!("assets/workbench.css")),
    ("post.js", "text/javascript; charset=utf-8", include_str!("assets/post.js")),
    ("refresh.js", "text/javascript; charset=utf-8", include_str!("assets/refresh.js")),
    ("theme.js", "text/javascript; charset=utf-8", include_str!("assets/theme.js")),
    ("icon.svg", "image/svg+xml", include_str!("assets/icon.svg")),
];

pub(crate) async fn asset(Path(name): Path<String>) -> Response {
    match ASSETS.iter().find(|(known, ..)| *known == name) {
        // Another version of the program has different assets at the same address, so a browser must revalidate them.
        Some((_, kind, text)) => ([(CONTENT_TYPE, *kind), (CACHE_CONTROL, "no-cache")], *text).into_response(),
        None => StatusCode::NOT_FOUND.into_response(),
    }
}
