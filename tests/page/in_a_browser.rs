//! The page in a browser, as a person sees it.

use data_encoding::BASE64;
use regrind_testcell::browser::{Browser, Tab};
use regrind_testutils::sample::all;
use serde_json::json;

use crate::program::{Running, changed, only_run, regrind, root, small_recipe};
use crate::{CellPage, SPEED, serve_with, users};

const SCREEN: [u32; 2] = [1024, 768];

fn banner(word: &str) -> String {
    format!("document.querySelector('#banner').innerText.includes('{word}')")
}

/// Returns the expression for the number of different colours on a canvas.
fn colours(canvas: &str) -> String {
    format!(
        "(() => {{ const c = document.querySelector('{canvas}'); const k = document.createElement('canvas'); k.width = c.width; \
         k.height = c.height; const x = k.getContext('2d'); x.drawImage(c, 0, 0); const d = x.getImageData(0, 0, k.width, k.height).data; \
         const s = new Set(); for (let i = 0; i < d.length; i += 4) if (d[i + 3]) s.add(d[i] << 16 | d[i + 1] << 8 | d[i + 2]); return s.size; }})()"
    )
}

fn is_old(browser: &mut Browser, tab: &Tab) -> bool {
    tab.read(browser, "document.body.classList.contains('old')") == true
}

#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn orders_show_in_every_tab() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 20.0);
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&shown.url, SCREEN);
    tab.until(&mut browser, &banner("EXECUTE"));
    // A second tab is harmless.
    let second = browser.open(&shown.url, [390, 844]);
    tab.click(&mut browser, "[data-order=hold]");
    tab.until(&mut browser, &banner("HELD"));
    assert!(tab.read(&mut browser, "document.querySelector('#next').innerText").as_str().unwrap().contains("RESUME"));
    second.until(&mut browser, &banner("HELD"));
    tab.click(&mut browser, "[data-order=resume]");
    second.until(&mut browser, &banner("EXECUTE"));
    // On a phone too, all of it is on the screen.
    let ends = second.read(&mut browser, "document.querySelector('.simulation').getBoundingClientRect().right");
    assert!(ends.as_f64().unwrap() <= 390.0, "{ends}");
    second.click(&mut browser, "[data-order=abort]");
    tab.until(&mut browser, &banner("ABORTED"));
    assert!(!is_old(&mut browser, &tab), "a run that is over is not old");
    for tab in [&tab, &second] {
        assert_eq!(tab.problems(&browser), Vec::<String>::new());
    }
    assert_eq!(shown.run.end().0, 3);
}

/// Expression for the places of the header, of the steps and of each order, and for everything that is wrong with the
/// layout: a page wider than the screen, elements that overlap, and targets that are too small for a finger.
const LAYOUT: &str = "(() => { \
    const box = (of) => { const b = of.getBoundingClientRect(); return [b.left, b.top + scrollY, b.right, b.bottom + scrollY].map(Math.round); }; \
    const all = (of) => [...document.querySelectorAll(of)].filter((e) => e.getClientRects().length); \
    const wrong = []; \
    if (document.documentElement.scrollWidth > innerWidth) wrong.push('wider than the screen'); \
    for (const group of ['.banner > *', '.steps > li', '.orders > *', 'main > *:not(.column), .column > *', 'nav > *']) { \
        const boxes = all(group).filter((e) => getComputedStyle(e).display !== 'contents').map(box); \
        boxes.forEach((a, k) => boxes.slice(k + 1).forEach((b) => { \
            if (a[0] < b[2] - 1 && b[0] < a[2] - 1 && a[1] < b[3] - 1 && b[1] < a[3] - 1) wrong.push(`${group}: ${a} and ${b}`); })); \
    } \
    for (const e of all('button, select, nav a')) { \
        const b = e.getBoundingClientRect(); \
        if (innerWidth < 500 && b.height < 43.5) wrong.push(`${e.outerHTML.slice(0, 60)} is ${b.height} px high`); \
    } \
    const fixed = all('.orders > button').map((e) => { const b = e.getBoundingClientRect(); return [b.left, b.top].map(Math.round); }); \
    return { places: [box(document.querySelector('#banner')), box(document.querySelector('.banner .state')), box(document.querySelector('.steps')), fixed], wrong }; })()";

#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn page_keeps_places_in_every_state() {
    let sizes: &[[u32; 2]] =
        if all() { &[[1920, 1080], [1366, 768], [1024, 768], [390, 844]] } else { &[[1366, 768], [390, 844]] };
    let languages: &[&str] = if all() { &["en", "de", "zh"] } else { &["en"] };
    languages.iter().for_each(|language| keeps_places(language, sizes));
}

/// Checks the places in a run of its own: a browser keeps at most six connections to one server.
fn keeps_places(language: &str, sizes: &[[u32; 2]]) {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 200.0);
    let held = crate::program::run(&["hold", &shown.folder.display().to_string()], home.path());
    assert_eq!(held.0, 0, "{held:?}");
    let mut browser = Browser::start(home.path());
    let mut tabs = Vec::new();
    for size in sizes {
        let tab = browser.open(&shown.url, *size);
        tab.until(&mut browser, "document.querySelector('.banner.held')");
        tab.read(
            &mut browser,
            &format!("window.isOld = true; document.cookie = 'regrind_language={language}; Path=/'"),
        );
        tab.send(&mut browser, "Page.reload", json!({}));
        tab.until(
            &mut browser,
            &format!(
                "!window.isOld && document.documentElement.lang === '{language}' && document.querySelector('.banner.held')"
            ),
        );
        tabs.push((tab, *size));
    }
    let themes = if all() { "['light', 'dark', 'contrast']" } else { "['light']" };
    // Each tab looks when a state appears, however late the test asks. On a slow computer the page says at times that it is old,
    // which takes a line of its own and is none of the states.
    for (tab, ..) in &tabs {
        let watching = format!(
            "document.getElementById('old').style.display = 'none'; \
             window.look = () => {themes}.map((theme) => {{ document.documentElement.dataset.theme = theme; return {LAYOUT}; }}); \
             window.kept = {{ held: look() }}; \
             new MutationObserver(() => {{ for (const state of ['runs', 'good']) \
             if (!kept[state] && document.querySelector(`.banner.${{state}}`)) kept[state] = look(); }})\
             .observe(document.body, {{ childList: true, subtree: true }})"
        );
        tab.read(&mut browser, &watching);
    }
    tabs[0].0.click(&mut browser, "[data-order=resume]");
    for (tab, size) in &tabs {
        tab.until(&mut browser, "kept.good");
        let kept = tab.read(&mut browser, "kept");
        let held = &kept["held"][0]["places"];
        assert!(held.is_array(), "{kept}");
        for state in ["held", "runs", "good"] {
            for look in kept[state].as_array().unwrap() {
                assert_eq!(look["wrong"], json!([]), "{state}, {size:?}, {language}");
                assert_eq!(look["places"], *held, "{state}, {size:?}, {language}");
            }
        }
    }
    assert_eq!(shown.run.end().0, 0);
}

#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn run_page_draws_map_and_relief() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 200.0);
    // Hold the run, so that it waits for the browser, however long that takes to start.
    let held = crate::program::run(&["hold", &shown.folder.display().to_string()], home.path());
    assert_eq!(held.0, 0, "{held:?}");
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&shown.url, SCREEN);
    tab.until(&mut browser, &banner("HELD"));
    tab.click(&mut browser, "[data-order=resume]");
    tab.until(&mut browser, "document.querySelectorAll('#cycle option').length > 0");
    tab.until(&mut browser, &format!("{} > 50", colours("#map")));
    tab.until(&mut browser, &banner("ACCEPTED"));
    tab.until(&mut browser, "document.querySelectorAll('#convergence circle').length >= 4");
    tab.click(&mut browser, "[data-view=relief]");
    tab.until(&mut browser, &format!("!document.querySelector('#relief').hidden && {} > 50", colours("#relief")));
    let before = tab.read(&mut browser, "document.querySelector('#relief').toDataURL()");
    tab.send(&mut browser, "Page.bringToFront", json!({}));
    tab.read(&mut browser, "document.querySelector('#relief').focus()");
    tab.press(&mut browser, "ArrowRight", 39, "");
    tab.until(&mut browser, &format!("document.querySelector('#relief').toDataURL() !== {before}"));
    tab.click(&mut browser, "[data-view=difference]");
    tab.until(&mut browser, &format!("!document.querySelector('#map').hidden && {} > 50", colours("#map")));
    // Closer, and back to the same picture.
    let whole = tab.read(&mut browser, "document.querySelector('#map').toDataURL()");
    tab.click(&mut browser, "[data-zoom=in]");
    tab.until(&mut browser, &format!("document.querySelector('#map').toDataURL() !== {whole}"));
    tab.click(&mut browser, "[data-zoom=out]");
    tab.until(&mut browser, &format!("document.querySelector('#map').toDataURL() === {whole}"));
    assert_eq!(tab.problems(&browser), Vec::<String>::new());
    assert_eq!(shown.run.end().0, 0);
}

#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn adaptive_map_shows_uncertainty() {
    let home = tempfile::tempdir().unwrap();
    let recipe = small_recipe(home.path(), 200.0);
    let text = std::fs::read_to_string(&recipe).unwrap();
    let measuring = "[measuring]\nmode = \"adaptive\"\naccepted_risk = 0.025\n\n[registration]";
    std::fs::write(&recipe, text.replacen("[registration]", measuring, 1)).unwrap();
    let mut shown = CellPage::start(home.path(), &recipe);
    let held = crate::program::run(&["hold", &shown.folder.display().to_string()], home.path());
    assert_eq!(held.0, 0, "{held:?}");
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&shown.url, SCREEN);
    tab.click(&mut browser, "[data-order=resume]");
    // The cell is held as soon as it has a map, however slow the browser is.
    let map = shown.folder.join("cycle-1/error_map.csv");
    shown.run.until("a first map", |_| map.exists().then_some(()));
    let held = crate::program::run(&["hold", &shown.folder.display().to_string()], home.path());
    assert_eq!(held.0, 0, "{held:?}");
    tab.until(&mut browser, &banner("HELD"));
    tab.click(&mut browser, "[data-view=sigma]");
    tab.until(&mut browser, "document.querySelector('#reading').innerText.includes('Standard uncertainty')");
    tab.until(&mut browser, &format!("{} > 50", colours("#map")));
    let known = |browser: &mut Browser| {
        let told = tab.read(browser, "document.querySelector('#reading').innerText.match(/[0-9.]+/)[0]");
        told.as_str().unwrap().parse::<f64>().unwrap()
    };
    let before = known(&mut browser);
    assert!(before > 0.0 && before < 10.0, "{before}");
    let picture = tab.read(&mut browser, "document.querySelector('#map').toDataURL()");
    tab.click(&mut browser, "[data-order=resume]");
    tab.until(&mut browser, &format!("document.querySelector('#map').toDataURL() !== {picture}"));
    tab.until(&mut browser, &banner("ACCEPTED"));
    assert_eq!(tab.problems(&browser), Vec::<String>::new());
    assert_eq!(shown.run.end().0, 0);
}

#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn page_of_killed_cell_disables_orders() {
    let home = tempfile::tempdir().unwrap();
    let shown = CellPage::begin(home.path(), 20.0);
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&shown.url, SCREEN);
    tab.until(&mut browser, &banner("EXECUTE"));
    shown.run.signal("KILL");
    tab.until(&mut browser, "document.body.classList.contains('old')");
    let words = tab.read(&mut browser, "document.querySelector('#old').innerText");
    assert!(words.as_str().unwrap().contains("No data since"), "{words}");
    tab.until(
        &mut browser,
        "[...document.querySelectorAll('.orders [data-order]')].every((button) => button.disabled)",
    );
    // A tab that opens later shows the same: data end with the record, not at the time of opening.
    let ended = "Date.parse(JSON.parse(document.getElementById('data').textContent).state.last)";
    tab.until(&mut browser, &format!("Date.now() - {ended} > 1500"));
    let later = browser.open(&format!("{}runs/{}", shown.visitor().origin() + "/", shown.id), SCREEN);
    later.until(&mut browser, "document.body.classList.contains('old')");
    let since = "document.querySelector('#old').innerText.match(/\\d+:\\d+:\\d+/)[0]";
    let of_record = format!("new Date({ended}).toLocaleTimeString().match(/\\d+:\\d+:\\d+/)[0]");
    assert_eq!(later.read(&mut browser, since), later.read(&mut browser, &of_record));
    shown.page.signal("KILL");
    tab.until(&mut browser, "document.querySelector('#old').innerText.includes('lost the connection')");
}

#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn keyboard_aborts_run() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 20.0);
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&shown.url, SCREEN);
    tab.until(&mut browser, &banner("EXECUTE"));
    tab.until(&mut browser, "!document.querySelector('[data-order=abort]').disabled");
    tab.send(&mut browser, "Page.bringToFront", json!({}));
    // On a computer at full load, a window can come to the front late. The page receives the keys anyway.
    tab.send(&mut browser, "Emulation.setFocusEmulationEnabled", json!({ "enabled": true }));
    let is_there = |browser: &mut Browser| tab.read(browser, "document.activeElement.dataset.order") == "abort";
    let mut presses = 0;
    while !is_there(&mut browser) && presses < 40 {
        tab.press(&mut browser, "Tab", 9, "");
        presses += 1;
    }
    let seen = "[document.activeElement.outerHTML.slice(0, 200), document.body.innerText.slice(0, 200)]";
    assert!(is_there(&mut browser), "after {presses} presses: {}", tab.read(&mut browser, seen));
    tab.press(&mut browser, "Enter", 13, "\r");
    tab.until(&mut browser, &banner("ABORTED"));
    assert_eq!(shown.run.end().0, 3);
}

#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn tls_sign_in_enables_role_orders() {
    let home = tempfile::tempdir().unwrap();
    for (name, role) in [("V. Guest", "viewer"), ("A. Smith", "operator")] {
        users::add(home.path(), name, role, users::PASSWORD);
    }
    let (certificate, key, _) = users::certificate(home.path());
    let recipe = small_recipe(home.path(), 20.0).display().to_string();
    let mut run = Running::new(regrind(&["run", &recipe, "--cell", "sim"], home.path()));
    run.line("grinding", |line| line.contains("grinding"));
    let arguments = ["--listen", "127.0.0.1:0", "--certificate", &certificate, "--key", &key, "--users", "users.toml"];
    let (_page, url) = serve_with(home.path(), &arguments);
    let url = url.replace("cell-2.example", "127.0.0.1");
    let mut browser = Browser::start(home.path());
    let tab = browser.open("about:blank", SCREEN);
    // The test made the certificate itself.
    tab.send(&mut browser, "Security.setIgnoreCertificateErrors", json!({ "ignore": true }));
    // On a connection on which scripts arrive later than the elements that they attach to.
    let slow = json!({ "offline": false, "latency": 150, "downloadThroughput": -1, "uploadThroughput": -1 });
    tab.send(&mut browser, "Network.emulateNetworkConditions", slow);
    tab.send(&mut browser, "Page.navigate", json!({ "url": url }));
    let sign_in = |browser: &mut Browser, name: &str, password: &str| {
        tab.until(browser, "document.querySelector('[name=password]')");
        let fill = |field: &str, value: &str| format!("document.querySelector('[name={field}]').value = '{value}';");
        tab.read(browser, &(fill("name", name) + &fill("password", password)));
        tab.click(browser, "main form button");
    };
    sign_in(&mut browser, "V. Guest", "not this one");
    tab.until(&mut browser, "document.querySelector('.no')?.innerText.includes('or the password is wrong')");
    sign_in(&mut browser, "V. Guest", users::PASSWORD);
    tab.until(&mut browser, &banner("EXECUTE"));
    let orders = "[...document.querySelectorAll('.orders [data-order]')]";
    assert_eq!(tab.read(&mut browser, &format!("{orders}.every((button) => button.disabled)")), true);
    tab.click(&mut browser, "#sign-out");
    sign_in(&mut browser, "A. Smith", users::PASSWORD);
    tab.until(&mut browser, &banner("EXECUTE"));
    assert!(tab.read(&mut browser, "document.querySelector('nav').innerText").as_str().unwrap().contains("A. Smith"));
    tab.click(&mut browser, "[data-order=abort]");
    tab.until(&mut browser, &banner("ABORTED"));
    assert_eq!(run.end().0, 3);
}

#[test]
#[ignore = "needs a browser and axe-core: REGRIND_AXE names its axe.min.js"]
fn axe_finds_nothing_serious() {
    let axe = std::fs::read_to_string(std::env::var("REGRIND_AXE").expect("REGRIND_AXE names axe.min.js")).unwrap();
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 200.0);
    assert_eq!(shown.run.end().0, 0);
    users::add(home.path(), "A. Smith", "operator", users::PASSWORD);
    let (_page, for_users) = serve_with(home.path(), &["--listen", "127.0.0.1:0", "--users", "users.toml"]);
    let mut browser = Browser::start(home.path());
    let place = shown.url.split("/?").next().unwrap().to_owned();
    let (run, runs) = (shown.url.clone(), format!("{place}/runs"));
    let compared = format!("{place}/compare?run={0}&run={0}", shown.id);
    let [machines, settings, components] = ["machines", "settings", "components"].map(|view| format!("{place}/{view}"));
    for (url, there) in [
        (&run, "document.querySelectorAll('#cycle option').length > 0"),
        (&runs, "document.querySelector('main table')"),
        (&compared, "document.querySelectorAll('.compare section').length == 2"),
        (&machines, "document.querySelector('.machines .pair')"),
        (&settings, "document.querySelector('.settings-view')"),
        (&components, "document.querySelector('.components')"),
        (&for_users, "document.querySelector('[name=password]')"),
    ] {
        let tab = browser.open(url, SCREEN);
        tab.until(&mut browser, there);
        tab.read(&mut browser, &format!("{axe};0"));
        for theme in ["light", "dark", "contrast"] {
            tab.read(&mut browser, &format!("document.documentElement.dataset.theme = '{theme}'"));
            let found = tab.read(
                &mut browser,
                "axe.run().then((found) => [found.passes.length, found.violations.filter((of) => ['serious', 'critical'].includes(of.impact))\
                 .map((of) => `${of.id}: ${of.nodes.map((node) => node.html).join(' ')}`)])",
            );
            assert!(found[0].as_u64() > Some(5) && found[1] == json!([]), "{url}, {theme}: {found}");
        }
    }
}

/// Views without a map, in each size and theme: nothing is wider than the screen, and no button is small on a phone.
#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn other_views_fit_every_screen() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 200.0);
    assert_eq!(shown.run.end().0, 0);
    let place = shown.url.split("/?").next().unwrap().to_owned();
    let themes: &[&str] = if all() { &["light", "dark", "contrast"] } else { &["light"] };
    let sizes: &[[u32; 2]] = if all() { &[[1920, 1080], [1024, 768], [390, 844]] } else { &[[1366, 768], [390, 844]] };
    let mut browser = Browser::start(home.path());
    for size in sizes {
        let tab = browser.open(&shown.url, *size);
        tab.until(&mut browser, "document.querySelector('.banner')");
        for view in ["machines", "settings", "components", "parts", "runs", "parts/SN-0042", "record"] {
            let path = if view == "record" { format!("runs/{}/record", shown.id) } else { view.to_owned() };
            tab.send(&mut browser, "Page.navigate", json!({ "url": format!("{place}/{path}") }));
            tab.until(&mut browser, &format!("location.href.endsWith('{view}') && document.querySelector('main h1')"));
            for theme in themes {
                let wrong = tab.read(
                    &mut browser,
                    &format!(
                        "(() => {{ document.documentElement.dataset.theme = '{theme}'; const wrong = []; \
                         if (document.documentElement.scrollWidth > innerWidth) wrong.push(document.documentElement.scrollWidth); \
                         for (const e of document.querySelectorAll('main button, nav select, nav a')) \
                         if (innerWidth < 500 && e.getBoundingClientRect().height < 43.5) wrong.push(e.outerHTML.slice(0, 80)); \
                         return wrong; }})()"
                    ),
                );
                assert_eq!(wrong, json!([]), "{view}, {size:?}, {theme}");
            }
        }
        assert_eq!(tab.problems(&browser), Vec::<String>::new());
    }
}

/// The report of an accepted part: four pages or fewer on A4 and on Letter, and nothing is wider than a page or a phone.
#[test]
#[ignore = "needs a browser: Debian package chromium"]
fn report_prints_on_four_pages() {
    let home = tempfile::tempdir().unwrap();
    let mut shown = CellPage::begin(home.path(), 1e4);
    assert_eq!(shown.run.end().0, 0);
    let mut browser = Browser::start(home.path());
    let place = format!("file://{}", shown.folder.join("report.html").display());
    let tab = browser.open(&place, [390, 844]);
    tab.until(&mut browser, "document.querySelector('#judged')");
    let width = tab.read(&mut browser, "document.documentElement.scrollWidth");
    assert!(width.as_f64().unwrap() <= 390.0, "{width}");
    for [width, height] in [[8.27, 11.69], [8.5, 11.0]] {
        let paper = json!({ "printBackground": true, "paperWidth": width, "paperHeight": height });
        let printed = tab.send(&mut browser, "Page.printToPDF", paper);
        let pdf = BASE64.decode(printed["data"].as_str().unwrap().as_bytes()).unwrap();
        let text = String::from_utf8_lossy(&pdf);
        let pages = text.matches("/Type /Page\n").count();
        assert!((2..=4).contains(&pages), "{width} x {height}: {pages} pages");
    }
}

/// Makes the pictures in the documentation from the current page.
#[test]
#[ignore = "writes into docs"]
fn pictures_are_made() {
    let home = tempfile::tempdir().unwrap();
    let recipe = home.path().join("freeform-mirror.toml");
    std::fs::write(&recipe, changed("recipes/freeform-mirror.toml", &[(SPEED, &format!("{SPEED}\nspeed = 200.0"))]))
        .unwrap();
    let mut shown = CellPage::start(home.path(), &recipe);
    let mut browser = Browser::start(home.path());
    let tab = browser.open(&shown.url, [1366, 768]);
    tab.until(&mut browser, "document.querySelectorAll('#cycle option').length > 0");
    tab.until(&mut browser, "document.querySelector('.steps .now progress')?.value > 300");
    let picture = |tab: &Tab, browser: &mut Browser, name: &str| {
        // A tab in the background is not painted.
        tab.send(browser, "Page.bringToFront", json!({}));
        // Wait for the last bytes to be painted. The picture is checked before it is kept.
        std::thread::park_timeout(std::time::Duration::from_secs(1));
        let shot = tab.send(browser, "Page.captureScreenshot", json!({ "format": "png" }));
        let decode = format!("base64 -d > '{}'", root().join("docs").join(name).display());
        let mut shell =
            std::process::Command::new("sh").args(["-c", &decode]).stdin(std::process::Stdio::piped()).spawn().unwrap();
        std::io::Write::write_all(&mut shell.stdin.take().unwrap(), shot["data"].as_str().unwrap().as_bytes()).unwrap();
        assert!(shell.wait().unwrap().success());
    };
    picture(&tab, &mut browser, "page.png");
    let machines = browser.open(&shown.url, [1366, 768]);
    machines.until(&mut browser, "document.querySelector('.banner')");
    let place = shown.url.split("/?").next().unwrap();
    machines.send(&mut browser, "Page.navigate", json!({ "url": format!("{place}/machines") }));
    machines.until(&mut browser, "document.querySelectorAll('.machines .chart').length >= 4");
    picture(&machines, &mut browser, "page-machines.png");
    tab.until(&mut browser, "document.querySelector('#cycle').value === 'live'");
    picture(&tab, &mut browser, "page-measuring.png");
    let phone = browser.open(&shown.url, [390, 844]);
    phone.until(&mut browser, &banner("EXECUTE"));
    picture(&phone, &mut browser, "page-phone.png");
    tab.until(&mut browser, &banner("ACCEPTED"));
    tab.click(&mut browser, "[data-view=relief]");
    picture(&tab, &mut browser, "page-relief.png");
    machines.send(&mut browser, "Page.navigate", json!({ "url": format!("{place}/runs/{}/record", shown.id) }));
    machines.until(&mut browser, "document.querySelector('.record table')");
    picture(&machines, &mut browser, "page-record.png");
    assert_eq!(shown.run.end().0, 0);
    let run = only_run(&home.path().join("runs"));
    let report = browser.open(&format!("file://{}", run.join("report.html").display()), [1000, 1000]);
    report.until(&mut browser, "document.querySelector('#judged') !== null");
    picture(&report, &mut browser, "report.png");
}
