//! Files that a browser saves.

use axum::http::header::{CACHE_CONTROL, CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};

/// Returns a response that a browser saves as a file named `name`. Characters that a header cannot have are left out. A
/// page can show a picture among these files; opened by itself, it is saved and runs nothing.
pub(crate) fn attachment(name: &str, bytes: Vec<u8>) -> Response {
    let plain: String = name.chars().filter(|c| c.is_ascii_graphic() && !"\"\\/".contains(*c)).collect();
    let headers = [
        (CONTENT_TYPE, content_type(&plain).to_owned()),
        (CONTENT_DISPOSITION, format!("attachment; filename=\"{plain}\"")),
        (CACHE_CONTROL, "no-store".to_owned()),
    ];
    (headers, bytes).into_response()
}

/// Returns the content type of a file by the ending of its name.
fn content_type(name: &str) -> &'static str {
    match name.rsplit_once('.').map_or("", |(_, ending)| ending) {
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "csv" => "text/csv",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attachment_name_is_plain() {
        let response = attachment("SN \"1\"/../\r\nä.csv", Vec::new());
        assert_eq!(response.headers()[CONTENT_DISPOSITION], "attachment; filename=\"SN1...csv\"");
        assert_eq!(response.headers()[CONTENT_TYPE], "text/csv");
    }

    #[test]
    fn pictures_have_their_type() {
        for (name, of) in [("map.svg", "image/svg+xml"), ("a.b.png", "image/png"), ("svg", "application/octet-stream")]
        {
            assert_eq!(content_type(name), of, "{name}");
        }
    }
}
