//! Files that a browser saves.

use axum::http::header::{CACHE_CONTROL, CONTENT_DISPOSITION, CONTENT_TYPE};
use axum::response::{IntoResponse, Response};

/// Returns a response that a browser saves as a file named `name`. Characters that a header cannot have are left out.
pub(crate) fn attachment(name: &str, bytes: Vec<u8>) -> Response {
    let plain: String = name.chars().filter(|c| c.is_ascii_graphic() && !"\"\\/".contains(*c)).collect();
    let headers = [
        (CONTENT_TYPE, "application/octet-stream".to_owned()),
        (CONTENT_DISPOSITION, format!("attachment; filename=\"{plain}\"")),
        (CACHE_CONTROL, "no-store".to_owned()),
    ];
    (headers, bytes).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attachment_name_is_plain() {
        let response = attachment("SN \"1\"/../\r\nä.csv", Vec::new());
        assert_eq!(response.headers()[CONTENT_DISPOSITION], "attachment; filename=\"SN1...csv\"");
    }
}
