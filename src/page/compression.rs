//! Compression of answers: text is sent as gzip to a browser that accepts it.

use axum::http::header::CONTENT_TYPE;
use axum::http::{Extensions, HeaderMap, StatusCode, Version};
use tower_http::CompressionLevel;
use tower_http::compression::CompressionLayer;
use tower_http::compression::predicate::{Predicate, SizeAbove};

/// Minimum length of an answer that is compressed, in bytes. A shorter one fits into one packet. The token for an order
/// is shorter too: the length of a compressed answer never depends on a secret.
const MIN_BYTES: u64 = 1024;
/// Content types that are compressed. Pictures as PNG, fonts and archives are compressed already. A stream of events
/// is not in the list: each event must reach the browser at once.
const COMPRESSED: [&str; 9] = [
    "text/html",
    "text/css",
    "text/csv",
    "text/javascript",
    "text/plain",
    "text/xml",
    "application/json",
    "application/xml",
    "image/svg+xml",
];

/// Returns the layer that compresses answers for browsers that accept gzip. It uses the fastest level: on the network of
/// a shop, a slower one would take longer than the bytes that it saves.
pub(crate) fn compression() -> CompressionLayer<impl Predicate> {
    let is_text = |_: StatusCode, _: Version, headers: &HeaderMap, _: &Extensions| is_compressed(headers);
    CompressionLayer::new().quality(CompressionLevel::Fastest).compress_when(SizeAbove::new(MIN_BYTES).and(is_text))
}

/// Returns true if the content type in `headers` is one of those that are compressed.
fn is_compressed(headers: &HeaderMap) -> bool {
    let of = headers.get(CONTENT_TYPE).and_then(|of| of.to_str().ok()).unwrap_or_default();
    let of = of.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
    COMPRESSED.contains(&of.as_str())
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn only_text_is_compressed() {
        let of =
            |kind: &'static str| is_compressed(&HeaderMap::from_iter([(CONTENT_TYPE, HeaderValue::from_static(kind))]));
        for kind in ["text/html; charset=utf-8", "Text/CSV", "application/json", "image/svg+xml", "application/xml"] {
            assert!(of(kind), "{kind}");
        }
        for kind in
            ["text/event-stream", "image/png", "application/octet-stream", "application/zip", "application/pdf", ""]
        {
            assert!(!of(kind), "{kind}");
        }
        assert!(!is_compressed(&HeaderMap::new()));
    }
}
