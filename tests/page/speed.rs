//! Times of the page, for `docs/figures.md`. They depend on the machine, so they are printed and not judged here.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use regrind_testcell::browser::{Browser, Tab};
use regrind_testcell::http::Visitor;

use crate::program::{Running, changed, regrind, replaced, small_recipe};
use crate::workbench::{of_simulation, post, simulate};
use crate::{CellPage, serve_with};

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

/// Returns the processor time of all children of a process since their begin, in seconds, of ended ones too.
fn processor_of_children_s(process: &Running) -> f64 {
    let text = std::fs::read_to_string(format!("/proc/{}/stat", process.id())).unwrap();
    let fields: Vec<&str> = text.rsplit(')').next().unwrap().split_whitespace().collect();
    // User and system time of the children that have ended, in hundredths of a second.
    let ended = (fields[13].parse::<f64>().unwrap() + fields[14].parse::<f64>().unwrap()) / 100.0;
    ended + process.children().into_iter().map(processor_s).sum::<f64>()
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

/// Returns the median time in ms from the click on HOLD of a run that grinds to HOLDING on the page.
fn hold_ms(browser: &mut Browser, tab: &Tab) -> f64 {
    let hold = "(async () => { const banner = document.querySelector('#banner'); const seen = new Promise((done) => \
                new MutationObserver(() => banner.innerText.includes('HOLDING') && done()).observe(banner, { childList: true, \
                subtree: true, characterData: true })); const began = performance.now(); \
                document.querySelector('[data-order=hold]').click(); await seen; return performance.now() - began; })()";
    let mut times = Vec::new();
    for _ in 0..TIMES {
        tab.until(browser, "!document.querySelector('[data-order=hold]').disabled");
        times.push(tab.read(browser, hold).as_f64().unwrap());
        tab.until(browser, "!document.querySelector('[data-order=resume]').disabled");
        tab.click(browser, "[data-order=resume]");
        tab.until(browser, "document.querySelector('#banner').innerText.includes('EXECUTE')");
    }
    median(times)
}

/// Returns the text of the small recipe with 28,476 points.
fn many_points(text: &str) -> String {
    replaced(&replaced(text, "columns = 16", "columns = 226"), "rows = 12", "rows = 126")
}

/// A whole part with 28,476 points, and its page.
#[test]
#[ignore = "measures, and needs a browser: Debian package chromium"]
fn page_with_many_points_is_fast() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 1e6);
    std::fs::write(&recipe, many_points(&std::fs::read_to_string(&recipe).unwrap())).unwrap();
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
    println!("HOLD to HOLDING on the page {:.0} ms", hold_ms(&mut browser, &tab));
    shown.run.signal("KILL");
}

/// A run that grinds, and beside it on the same computer a webhook that never answers, then simulations of the
/// workbench one after the other: the time from the click on HOLD to its effect.
#[test]
#[ignore = "measures, and needs a browser (Debian package chromium) and the feature plant"]
fn hold_is_fast_beside_other_programs() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 1.0);
    shown.run.line("grinding", |line| line.contains("grinding"));
    let recipes = home.path().join("recipes");
    std::fs::create_dir(&recipes).unwrap();
    let (page, url) = serve_with(home.path(), &["--listen", "127.0.0.1:0", "--recipes", "recipes"]);
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&url.replace("/?", &format!("/runs/{}?", shown.id)), [1366, 768]);
    println!("HOLD to HOLDING on the page, nothing beside, {:.0} ms", hold_ms(&mut browser, &tab));

    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let webhook = format!(
        "[plant]\ncell = \"cell-1\"\n\n[[notify.webhook]]\nname = \"chat\"\nurl = \"http://{}/\"\nevents = [\"started\", \"held\"]\n",
        silent.local_addr().unwrap()
    );
    std::fs::write(home.path().join("plant.toml"), webhook).unwrap();
    let mut notifier = Running::new(regrind(&["notify", "--plant", "plant.toml", "--json"], home.path()));
    // It reads the first notification, and its connection stays open.
    let (mut request, _) = silent.accept().unwrap();
    request.read_exact(&mut [0; 4]).unwrap();
    let median = hold_ms(&mut browser, &tab);
    println!("HOLD to HOLDING on the page, beside a webhook that never answers, {median:.0} ms");
    assert!(!notifier.is_over());
    notifier.signal("KILL");

    // The shipped recipe, whose machines need no time, so that the simulation computes nearly all of its time.
    let speed = ("[simulation]\nseed = 1", "[simulation]\nseed = 1\nspeed = 1e6");
    let text = changed("recipes/freeform-mirror.toml", &[speed]);
    let visitor = Visitor::with_key(&url);
    let (is_over, simulations, last_id) = (AtomicBool::new(false), AtomicUsize::new(0), AtomicU64::new(0));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !is_over.load(Ordering::Relaxed) {
                let id = simulate(&visitor, &text);
                last_id.store(id, Ordering::Relaxed);
                simulations.fetch_add(1, Ordering::Relaxed);
                assert_eq!(visitor.get(&of_simulation("events", id)).status, 200);
            }
        });
        let began = (Instant::now(), processor_of_children_s(&page));
        let median = hold_ms(&mut browser, &tab);
        is_over.store(true, Ordering::Relaxed);
        let share = (processor_of_children_s(&page) - began.1) / began.0.elapsed().as_secs_f64();
        println!("HOLD to HOLDING on the page, beside a simulation, {median:.0} ms");
        println!("{simulations:?} simulations, {:.0} % of a core", 100.0 * share);
        post(&visitor, &of_simulation("end", last_id.load(Ordering::Relaxed)), &serde_json::json!(null));
    });
    shown.run.signal("KILL");
}
