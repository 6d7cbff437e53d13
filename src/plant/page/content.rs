//! Content of a page, and the HTML page that shows it.

use axum::response::Response;
use maud::Markup;
use regrind_page::{Reader, plant_document};

use super::page_error::{PageError, unmade, within};
use super::style::STYLE;

/// Finished page.
pub(super) struct PageContent {
    pub(super) title: String,
    pub(super) again_s: Option<u32>,
    pub(super) main: Markup,
}

/// Returns the HTML page whose content the future `making` computes. If `making` fails, or takes longer than the time
/// limit (15 s), returns a page with the reason. `reader` is the reader of the page.
pub(super) async fn page(reader: &Reader, making: impl Future<Output = Result<PageContent, PageError>>) -> Response {
    match within(making).await {
        Ok(PageContent { title, again_s, main }) => plant_document(&title, reader, again_s, STYLE, main),
        Err(reason) => unmade(reader, &reason),
    }
}
