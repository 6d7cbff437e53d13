//! Times of the page, for `docs/figures.md`. They depend on the machine, so they are printed and not judged here.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use regrind_testcell::browser::{Browser, Tab};

use crate::CellPage;
use crate::program::{replaced, small_recipe};

/// Number of repetitions of each time.
const TIMES: usize = 20;
/// Number of browsers that look at one run.
const VIEWERS: usize = 64;

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Returns the processor time of a process since its begin, in seconds.
fn processor_s(process: u32) -> f64 {
    let text = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    let fields: Vec<&str> = text.rsplit(')').next().unwrap().split_whitespace().collect();
    // User and system time, in hundredths of a second.
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

/// Returns the median time in ms from a reload to the first paint of content.
fn first_paint_ms(browser: &mut Browser, tab: &Tab) -> f64 {
    let paint = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime";
    let times = (0..TIMES).map(|_| {
        tab.read(browser, "window.isOld = true");
        tab.send(browser, "Page.reload", serde_json::json!({}));
        tab.until(browser, &format!("!window.isOld && {paint}"));
        tab.read(browser, paint).as_f64().unwrap()
    });
    median(times.collect())
}

/// Returns the median time in ms from a click to the frame after the one that shows its effect. This contains at least
/// one interval of frames, 16.7 ms.
fn redraw_ms(browser: &mut Browser, tab: &Tab, selector: &str) -> f64 {
    let click = format!(
        "(async () => {{ const began = performance.now(); document.querySelector('{selector}').click(); \
         for (let k = 0; k < 2; k++) await new Promise(requestAnimationFrame); return performance.now() - began; }})()"
    );
    median((0..TIMES).map(|_| tab.read(browser, &click).as_f64().unwrap()).collect())
}

/// A whole part with 28,476 points, and its page.
#[test]
#[ignore = "measures, and needs a browser: Debian package chromium"]
fn page_with_many_points_is_fast() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e6);
    let text = std::fs::read_to_string(&recipe).unwrap();
    let text = replaced(&text, "columns = 16", "columns = 226");
    std::fs::write(&recipe, replaced(&text, "rows = 12", "rows = 126")).unwrap();
    let mut shown = CellPage::start(home.path(), &recipe);
    // The map of the first cycle is enough, whatever the verdict on the part is.
    assert!(shown.run.end().0 <= 1);
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&shown.url, [1366, 768]);
    tab.until(&mut browser, "document.querySelectorAll('#cycle option').length > 0");
    println!("first paint {:.0} ms", first_paint_ms(&mut browser, &tab));
    tab.until(&mut browser, "document.querySelectorAll('#cycle option').length > 0");
    // The points arrive when they are first shown.
    tab.click(&mut browser, "[data-points]");
    tab.until(&mut browser, "document.querySelector('[data-points]').ariaPressed === 'true'");
    std::thread::park_timeout(Duration::from_secs(2));
    println!("map without or with 28,476 points {:.1} ms", redraw_ms(&mut browser, &tab, "[data-points]"));
}

/// Browsers at a run that grinds: the processor time of the page, and the time from the click on HOLD to its effect.
#[test]
#[ignore = "measures, and needs a browser: Debian package chromium"]
fn many_viewers_cost_little() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 1.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let visitor = shown.visitor();
    let viewers: Vec<TcpStream> = (0..VIEWERS)
        .map(|_| {
            let mut events = TcpStream::connect(&visitor.place).unwrap();
            let (host, cookies) = (visitor.host(), &visitor.cookies);
            let request =
                format!("GET /runs/{}/events HTTP/1.1\r\nHost: {host}\r\nCookie: {cookies}\r\n\r\n", shown.id);
            events.write_all(request.as_bytes()).unwrap();
            events.read_exact(&mut [0; 12]).unwrap();
            let mut own = events.try_clone().unwrap();
            std::thread::spawn(move || std::io::copy(&mut own, &mut std::io::sink()));
            events
        })
        .collect();
    let (began, before) = (Instant::now(), processor_s(shown.page.id()));
    std::thread::park_timeout(Duration::from_secs(20));
    let share = (processor_s(shown.page.id()) - before) / began.elapsed().as_secs_f64();
    println!("{} viewers {:.1} % of a core", viewers.len(), 100.0 * share);
    drop(viewers);
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&shown.url, [1366, 768]);
    let order = |order: &str, word: &str| {
        format!(
            "(async () => {{ const banner = document.querySelector('#banner'); const seen = new Promise((done) => \
             new MutationObserver(() => banner.innerText.includes('{word}') && done()).observe(banner, {{ childList: true, \
             subtree: true, characterData: true }})); const began = performance.now(); \
             document.querySelector('[data-order={order}]').click(); await seen; return performance.now() - began; }})()"
        )
    };
    let mut times = Vec::new();
    for _ in 0..TIMES {
        tab.until(&mut browser, "!document.querySelector('[data-order=hold]').disabled");
        times.push(tab.read(&mut browser, &order("hold", "HOLDING")).as_f64().unwrap());
        tab.until(&mut browser, "!document.querySelector('[data-order=resume]').disabled");
        tab.click(&mut browser, "[data-order=resume]");
        tab.until(&mut browser, "document.querySelector('#banner').innerText.includes('EXECUTE')");
    }
    println!("HOLD to HOLDING on the page {:.0} ms", median(times));
    shown.run.signal("KILL");
}
