//! A display for tests: an X server without a screen, with synthetic mouse and keyboard.
#![allow(dead_code, reason = "each test file uses a part")]

use std::io::{BufRead as _, BufReader, Write as _};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use x11rb::connection::Connection as _;
use x11rb::protocol::xproto::{
    self, AtomEnum, BUTTON_PRESS_EVENT, BUTTON_RELEASE_EVENT, ClientMessageEvent, ConfigureWindowAux,
    ConnectionExt as _, EventMask, InputFocus, KEY_PRESS_EVENT, KEY_RELEASE_EVENT, MOTION_NOTIFY_EVENT,
};
use x11rb::protocol::xtest::ConnectionExt as _;
use x11rb::rust_connection::RustConnection;

/// Runs a test in a new process with a display of its own, because a process has one event loop of windows.
///
/// Without Xvfb, the test passes and says so.
pub fn in_display(test: &str, work: impl FnOnce(Display)) {
    if std::env::var_os(INSIDE).is_some() {
        work(Display::connect(std::env::var("DISPLAY").unwrap().as_str()));
        return;
    }
    let Some(server) = Server::start() else {
        let _ = writeln!(std::io::stderr(), "{test}: skipped, because Xvfb is not installed");
        return;
    };
    let output = Command::new(std::env::current_exe().unwrap())
        .args([test, "--exact", "--nocapture", "--include-ignored"])
        .env(INSIDE, server.child.id().to_string())
        .env("DISPLAY", &server.name)
        .env_remove("WAYLAND_DISPLAY")
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned() + &String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{text}");
    // the test has run in the other process, and the windows have printed nothing
    assert!(text.contains("1 passed"), "{text}");
    assert!(!text.contains("panicked"), "{text}");
}

/// Variable with the process id of the X server, in the process of a test.
const INSIDE: &str = "VIEWER_TEST_SERVER";

/// X server. The end of the value ends it.
pub struct Server {
    child: Child,
    pub name: String,
}

impl Server {
    /// Starts a server on a free display; `None` if Xvfb is not installed.
    pub fn start() -> Option<Self> {
        let mut child = Command::new("Xvfb")
            .args(["-displayfd", "1", "-screen", "0", "1400x900x24", "-nolisten", "tcp", "-noreset"])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .ok()?;
        let mut line = String::new();
        BufReader::new(child.stdout.take()?).read_line(&mut line).ok()?;
        Some(Self { child, name: format!(":{}", line.trim()) })
    }

    /// Ends the server, as a crash would.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Connection of the person: sees windows, moves the mouse and types.
pub struct Display {
    connection: RustConnection,
    root: xproto::Window,
}

impl Display {
    pub fn connect(name: &str) -> Self {
        let (connection, screen) = x11rb::connect(Some(name)).unwrap();
        let root = connection.setup().roots[screen].root;
        Self { connection, root }
    }

    /// Ends the server of the test.
    pub fn kill_server(&self) {
        let id = std::env::var(INSIDE).unwrap();
        assert!(Command::new("kill").args(["-9", &id]).status().unwrap().success());
    }

    /// Returns the windows with a title, after they are visible.
    pub fn windows(&self, title: &str, count: usize) -> Vec<xproto::Window> {
        wait_until(&format!("{count} windows of {title}"), || {
            let found = self.find(title);
            (found.len() == count).then_some(found)
        })
    }

    fn find(&self, title: &str) -> Vec<xproto::Window> {
        let tree = self.connection.query_tree(self.root).unwrap().reply().unwrap();
        let named = |window: &&xproto::Window| {
            let name = self.connection.get_property(false, **window, AtomEnum::WM_NAME, AtomEnum::ANY, 0, 100);
            let is_named = name.unwrap().reply().is_ok_and(|name| name.value == title.as_bytes());
            let attributes = self.connection.get_window_attributes(**window).unwrap().reply();
            is_named && attributes.is_ok_and(|attributes| attributes.map_state == xproto::MapState::VIEWABLE)
        };
        tree.children.iter().filter(named).copied().collect()
    }

    /// Presses the close button of a window, as a window manager does.
    pub fn close(&self, window: xproto::Window) {
        let atom = |name: &[u8]| self.connection.intern_atom(false, name).unwrap().reply().unwrap().atom;
        let data = [atom(b"WM_DELETE_WINDOW"), x11rb::CURRENT_TIME, 0, 0, 0];
        let event = ClientMessageEvent::new(32, window, atom(b"WM_PROTOCOLS"), data);
        self.connection.send_event(false, window, EventMask::NO_EVENT, event).unwrap();
        self.connection.flush().unwrap();
    }

    /// Gives a window the keyboard.
    pub fn focus(&self, window: xproto::Window) {
        self.connection.set_input_focus(InputFocus::PARENT, window, x11rb::CURRENT_TIME).unwrap().check().unwrap();
        // the window learns it with its next event
        std::thread::sleep(Duration::from_millis(200));
    }

    pub fn resize(&self, window: xproto::Window, width: u32, height: u32) {
        let size = ConfigureWindowAux::new().width(width).height(height);
        self.connection.configure_window(window, &size).unwrap().check().unwrap();
    }

    fn fake(&self, kind: u8, detail: u8, x: i16, y: i16) {
        self.connection.xtest_fake_input(kind, detail, 0, self.root, x, y, 0).unwrap().check().unwrap();
        // the window reads events between its images
        std::thread::sleep(Duration::from_millis(40));
    }

    pub fn move_to(&self, x: i16, y: i16) {
        self.fake(MOTION_NOTIFY_EVENT, 0, x, y);
    }

    pub fn press(&self, button: u8) {
        self.fake(BUTTON_PRESS_EVENT, button, 0, 0);
    }

    pub fn release(&self, button: u8) {
        self.fake(BUTTON_RELEASE_EVENT, button, 0, 0);
    }

    pub fn click(&self, x: i16, y: i16) {
        self.move_to(x, y);
        self.press(1);
        self.release(1);
    }

    /// Drags with a mouse button in ten movements.
    pub fn drag(&self, button: u8, from: [i16; 2], to: [i16; 2]) {
        self.move_to(from[0], from[1]);
        self.press(button);
        for step in 1..=10 {
            let at = |i: usize| from[i] + (to[i] - from[i]) / 10 * step;
            self.move_to(at(0), at(1));
        }
        self.move_to(to[0], to[1]);
        self.release(button);
    }

    /// Returns the code of the key with a symbol, and whether it needs shift.
    fn key_code(&self, symbol: u32) -> (u8, bool) {
        let setup = self.connection.setup();
        let (low, high) = (setup.min_keycode, setup.max_keycode);
        let mapping = self.connection.get_keyboard_mapping(low, high - low + 1).unwrap().reply().unwrap();
        let width = usize::from(mapping.keysyms_per_keycode);
        let index = mapping.keysyms.iter().position(|&own| own == symbol).expect("a key of the keyboard");
        (low + (index / width) as u8, index % width == 1)
    }

    /// Types a key: its X11 symbol, which is the character for letters and digits.
    pub fn key(&self, symbol: u32) {
        let (code, shift) = self.key_code(symbol);
        if shift {
            self.key_down(SHIFT);
        }
        self.fake(KEY_PRESS_EVENT, code, 0, 0);
        self.fake(KEY_RELEASE_EVENT, code, 0, 0);
        if shift {
            self.key_up(SHIFT);
        }
    }

    pub fn key_down(&self, symbol: u32) {
        self.fake(KEY_PRESS_EVENT, self.key_code(symbol).0, 0, 0);
    }

    pub fn key_up(&self, symbol: u32) {
        self.fake(KEY_RELEASE_EVENT, self.key_code(symbol).0, 0, 0);
    }

    pub fn text(&self, keys: &str) {
        keys.chars().for_each(|key| self.key(key as u32));
    }
}

pub const SHIFT: u32 = 0xffe1;
pub const CONTROL: u32 = 0xffe3;
pub const LEFT: u32 = 0xff51;
pub const UP: u32 = 0xff52;
pub const TAB: u32 = 0xff09;
pub const BACKSPACE: u32 = 0xff08;

/// Waits for a value, at most 20 s.
pub fn wait_until<T>(what: &str, mut get: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = get() {
            return value;
        }
        assert!(start.elapsed() < Duration::from_secs(20), "waited in vain for {what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
