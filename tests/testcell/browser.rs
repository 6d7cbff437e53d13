//! Headless browser, driven by the pipe of Chromium's remote debugging: a JSON message, then a zero byte.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, channel};
use std::time::Instant;

use serde_json::{Value, json};

use crate::program::PATIENCE;

/// Headless browser, which ends with the test.
pub struct Browser {
    child: Child,
    to: File,
    from: Receiver<Value>,
    sent: u64,
    /// Events that arrived during a wait for something else.
    pub events: Vec<Value>,
}

impl Browser {
    /// Starts a browser that keeps its profile in a folder.
    pub fn start(folder: &Path) -> Self {
        let [to, from] = ["to", "from"].map(|name| folder.join(name).display().to_string());
        assert!(Command::new("mkfifo").args([&to, &from]).status().unwrap().success());
        // The shell passes the two pipes as the descriptors on which the browser reads and writes.
        let command = "exec chromium --headless=new --no-sandbox --remote-debugging-pipe --user-data-dir=\"$3\" --no-first-run --disable-background-networking --disable-component-update --disable-sync \
                       --disable-dev-shm-usage --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader 3<\"$1\" 4>\"$2\"";
        let child = Command::new("sh")
            .args(["-c", command, "sh", &to, &from, &folder.join("profile").display().to_string()])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        // Each open blocks until the other end is opened, in the order in which the shell opens them.
        let to = OpenOptions::new().write(true).open(to).unwrap();
        let mut reader = BufReader::new(File::open(from).unwrap());
        let (heard, from) = channel();
        std::thread::spawn(move || {
            let mut text = Vec::new();
            while reader.read_until(0, &mut text).is_ok_and(|read| read > 0) {
                text.pop();
                let message = serde_json::from_slice(&text).unwrap_or(Value::Null);
                text.clear();
                if heard.send(message).is_err() {
                    return;
                }
            }
        });
        Self { child, to, from, sent: 0, events: Vec::new() }
    }

    /// Calls a method of the browser, or of a tab by its session. Returns the result.
    pub fn send(&mut self, session: Option<&str>, method: &str, params: Value) -> Value {
        self.call(session, method, params).unwrap_or_else(|message| panic!("{method}: {message}"))
    }

    /// Calls a method of the browser, or of a tab by its session. Returns the result, or the answer that refuses it.
    fn call(&mut self, session: Option<&str>, method: &str, params: Value) -> Result<Value, Value> {
        self.sent += 1;
        let id = self.sent;
        let mut message = json!({ "id": id, "method": method, "params": params });
        if let Some(session) = session {
            message["sessionId"] = json!(session);
        }
        self.to.write_all(format!("{message}\0").as_bytes()).unwrap();
        loop {
            let message = self.from.recv_timeout(PATIENCE).unwrap_or_else(|_| panic!("no answer to {method}"));
            if message["id"] == id {
                return if message["error"].is_null() { Ok(message["result"].clone()) } else { Err(message) };
            }
            self.events.push(message);
        }
    }

    /// Opens a page in a tab of its own.
    pub fn open(&mut self, url: &str, [width, height]: [u32; 2]) -> Tab {
        let target = self.send(None, "Target.createTarget", json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let session = self.send(None, "Target.attachToTarget", attach)["sessionId"].as_str().unwrap().to_owned();
        let tab = Tab { session };
        for room in ["Page", "Runtime", "Network", "Log"] {
            tab.send(self, &format!("{room}.enable"), json!({}));
        }
        let size = json!({ "width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600 });
        tab.send(self, "Emulation.setDeviceMetricsOverride", size);
        tab.send(self, "Page.navigate", json!({ "url": url }));
        tab
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        // The process has possibly ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Tab with a page.
pub struct Tab {
    session: String,
}

impl Tab {
    /// Calls a method of the tab. Returns the result.
    pub fn send(&self, browser: &mut Browser, method: &str, params: Value) -> Value {
        browser.send(Some(&self.session), method, params)
    }

    /// Returns the value of an expression in the page; null if it is not available yet.
    pub fn read(&self, browser: &mut Browser, expression: &str) -> Value {
        self.evaluate(browser, expression).unwrap_or_else(|message| panic!("{expression}: {message}"))
    }

    /// Returns the value of an expression in the page, or the answer that refuses it.
    fn evaluate(&self, browser: &mut Browser, expression: &str) -> Result<Value, Value> {
        let params = json!({ "expression": expression, "awaitPromise": true, "returnByValue": true });
        Ok(browser.call(Some(&self.session), "Runtime.evaluate", params)?["result"]["value"].clone())
    }

    /// Waits until an expression is true.
    pub fn until(&self, browser: &mut Browser, expression: &str) {
        let began = Instant::now();
        // The browser refuses a question if the tab moves to another page before the answer. The next page answers.
        while self.evaluate(browser, &format!("Boolean({expression})")) != Ok(Value::Bool(true)) {
            if began.elapsed() >= PATIENCE {
                let shown = self.evaluate(browser, "[location.href, document.readyState, document.body?.innerText]");
                panic!("never: {expression}; shown is {shown:?}");
            }
            std::thread::park_timeout(std::time::Duration::from_millis(20));
        }
    }

    /// Clicks an element as soon as it listens: the scripts of the page attach their handlers after the element is
    /// visible.
    pub fn click(&self, browser: &mut Browser, selector: &str) {
        self.until(
            browser,
            &format!(
                "document.readyState == 'complete' && document.querySelector('{selector}') && !document.querySelector('{selector}').disabled"
            ),
        );
        // The click possibly moves the tab to another page before the answer: the browser then refuses the answer.
        let _ = self.evaluate(browser, &format!("document.querySelector('{selector}').click()"));
    }

    /// Presses a key, given by its name, its code, and the text that it types.
    pub fn press(&self, browser: &mut Browser, key: &str, code: u32, text: &str) {
        self.until(browser, "document.readyState == 'complete'");
        for kind in ["keyDown", "keyUp"] {
            let mut event = json!({ "type": kind, "key": key, "code": key, "windowsVirtualKeyCode": code });
            if kind == "keyDown" && !text.is_empty() {
                event["text"] = json!(text);
            }
            self.send(browser, "Input.dispatchKeyEvent", event);
        }
    }

    /// Returns script errors, messages in the console, and requests that left this computer.
    pub fn problems(&self, browser: &Browser) -> Vec<String> {
        let of_this = browser.events.iter().filter(|event| event["sessionId"] == self.session.as_str());
        let problem = |event: &Value| {
            let params = &event["params"];
            match event["method"].as_str()? {
                "Runtime.exceptionThrown" => Some(params["exceptionDetails"].to_string()),
                "Runtime.consoleAPICalled" if params["type"] != "log" => Some(params["args"].to_string()),
                "Log.entryAdded" => Some(params["entry"].to_string()),
                "Network.requestWillBeSent" => {
                    let url = params["request"]["url"].as_str()?;
                    let here = ["http://127.0.0.1:", "data:", "about:"].iter().any(|begin| url.starts_with(begin));
                    (!here).then(|| format!("a request for {url}"))
                }
                _ => None,
            }
        };
        of_this.filter_map(problem).collect()
    }
}
