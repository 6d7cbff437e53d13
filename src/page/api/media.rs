//! Choice of the media type of an answer by the header `Accept` (RFC 9110, 12.5.1).

use axum::http::HeaderMap;
use axum::http::header::ACCEPT;

/// Returns the media type of `offered` that the client prefers, and the first one of several that it prefers alike. Without
/// a header `Accept`, every type is accepted. Returns `None` if none of them is accepted. Parameters of an accepted type
/// except `q` are ignored.
pub(super) fn preferred(headers: &HeaderMap, offered: &[&'static str]) -> Option<&'static str> {
    let accepted: Vec<&str> = headers.get_all(ACCEPT).iter().map(|value| value.to_str().unwrap_or_default()).collect();
    if accepted.is_empty() {
        return offered.first().copied();
    }
    let ranges: Vec<Range> = accepted.iter().flat_map(|value| value.split(',')).filter_map(Range::parse).collect();
    let quality = |media: &str| {
        let fitting = ranges.iter().filter_map(|range| Some((range.fit(media)?, range.quality)));
        fitting.max_by_key(|(fit, quality)| (*fit, *quality)).map_or(0, |(_, quality)| quality)
    };
    let best = offered.iter().map(|media| quality(media)).max().filter(|best| *best > 0)?;
    offered.iter().find(|media| quality(media) == best).copied()
}

/// Range of media types.
struct Range<'a> {
    kind: &'a str,
    subkind: &'a str,
    /// Weight in thousandths.
    quality: u32,
}

impl<'a> Range<'a> {
    /// Parses a range such as `text/*;q=0.5`. Returns `None` if it is not one.
    fn parse(text: &'a str) -> Option<Self> {
        let mut parts = text.split(';').map(str::trim);
        let (kind, subkind) = parts.next()?.split_once('/')?;
        let is_q = |part: &&str| part.get(..2).is_some_and(|begin| begin.eq_ignore_ascii_case("q="));
        let quality = match parts.find(is_q) {
            Some(weight) => weight[2..].parse::<f64>().ok().filter(|weight| (0.0..=1.0).contains(weight))?,
            None => 1.0,
        };
        Some(Self { kind, subkind, quality: (1e3 * quality).round() as u32 })
    }

    /// Returns how closely the range names the type `media`: 2 if it names the type itself, 0 if it names all types.
    /// Returns `None` if the range does not contain it.
    fn fit(&self, media: &str) -> Option<u8> {
        let (kind, subkind) = media.split(';').next()?.split_once('/')?;
        match (self.kind, self.subkind) {
            ("*", "*") => Some(0),
            (of, "*") if of.eq_ignore_ascii_case(kind) => Some(1),
            (of, sub) if of.eq_ignore_ascii_case(kind) && sub.eq_ignore_ascii_case(subkind) => Some(2),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use axum::http::HeaderValue;

    use super::*;

    #[test]
    fn preferred_media_type() {
        const OFFERED: [&str; 2] = ["text/plain; version=0.0.4", "application/openmetrics-text; version=1.0.0"];
        let index = |accept: &'static str| {
            let headers = HeaderMap::from_iter([(ACCEPT, HeaderValue::from_static(accept))]);
            preferred(&headers, &OFFERED).map(|of| OFFERED.iter().position(|offered| *offered == of).unwrap())
        };
        for (accept, expected) in [
            ("*/*", Some(0)),
            ("text/*", Some(0)),
            ("application/openmetrics-text;version=1.0.0;q=0.6,text/plain;version=0.0.4;q=0.5,*/*;q=0.1", Some(1)),
            ("application/openmetrics-text;q=0.4,text/plain;q=0.5", Some(0)),
            ("text/plain;q=0, */*", Some(1)),
            ("Application/OpenMetrics-Text", Some(1)),
            ("application/json", None),
            ("*/*;q=0", None),
            ("", None),
            ("nonsense", None),
            ("text/plain;q=2", None),
            ("text/plain;q=NaN", None),
        ] {
            assert_eq!(index(accept), expected, "{accept}");
        }
        assert_eq!(preferred(&HeaderMap::new(), &OFFERED), Some(OFFERED[0]));
    }
}
