//! Browsers that show a run now.

use std::time::Duration;

use tokio::sync::watch;

/// Number of open pages of runs.
#[derive(Clone)]
pub struct Viewers {
    open_pages: watch::Sender<usize>,
}

/// Open page of a run. It counts until this value is dropped.
pub(crate) struct Viewer {
    open_pages: watch::Sender<usize>,
}

impl Viewers {
    pub(crate) fn new() -> Self {
        Self { open_pages: watch::Sender::new(0) }
    }

    /// Counts one more open page for as long as the returned value exists.
    pub(crate) fn enter(&self) -> Viewer {
        self.open_pages.send_modify(|count| *count += 1);
        Viewer { open_pages: self.open_pages.clone() }
    }

    /// Waits until a page is open.
    pub async fn come(&self) {
        let mut count = self.open_pages.subscribe();
        // The sender lives as long as this value, so waiting does not fail.
        let _ = count.wait_for(|open| *open > 0).await;
    }

    /// Waits until no page has been open for the duration `quiet`. A page that is opened within this time, even for
    /// a moment, begins it anew.
    pub async fn gone(&self, quiet: Duration) {
        let mut count = self.open_pages.subscribe();
        // The sender lives as long as this value, so waiting does not fail.
        while count.wait_for(|open| *open == 0).await.is_ok() {
            if tokio::time::timeout(quiet, count.changed()).await.is_err() {
                return;
            }
        }
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        self.open_pages.send_modify(|count| *count -= 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const QUIET: Duration = Duration::from_secs(60);

    #[tokio::test(start_paused = true)]
    async fn viewers_are_gone_after_the_last_one() {
        let viewers = Viewers::new();
        let began = tokio::time::Instant::now();
        let (first, second) = (viewers.enter(), viewers.enter());
        let gone = tokio::spawn({
            let viewers = viewers.clone();
            async move {
                viewers.gone(QUIET).await;
                tokio::time::Instant::now()
            }
        });
        tokio::time::sleep(Duration::from_secs(100)).await;
        drop(first);
        tokio::time::sleep(Duration::from_secs(100)).await;
        drop(second);
        // A page that is loaded again.
        tokio::time::sleep(Duration::from_secs(50)).await;
        drop(viewers.enter());
        assert_eq!((gone.await.unwrap() - began).as_secs(), 310);
    }
}
