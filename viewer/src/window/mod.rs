//! The thread of all windows of a process.

mod gl;
mod priority;
mod surface;
mod x11;

use std::cell::Cell;
use std::collections::HashMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError, Weak, mpsc};
use std::time::{Duration, Instant};

use winit::application::ApplicationHandler;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop, EventLoopProxy};
use winit::window::{WindowAttributes, WindowId};

use crate::error::ViewerError;
use crate::shared::Shared;
use crate::viewer::ViewerOptions;
use gl::GlWindow;
pub use priority::lower as lower_priority;
use surface::ViewWindow;

/// Message to the thread of the windows.
enum Message {
    /// Opens a window and answers.
    Open(Arc<Shared>, ViewerOptions, mpsc::SyncSender<Result<(), ViewerError>>),
    /// A flight has changed.
    Changed,
    /// Creates an invisible window and answers.
    Check(mpsc::SyncSender<Result<(), ViewerError>>),
    /// Closes all windows and answers.
    CloseAll(mpsc::SyncSender<()>),
}

/// Thread of the windows.
struct WindowThread {
    proxy: Mutex<EventLoopProxy<Message>>,
    process: u32,
}

static THREAD: OnceLock<Result<WindowThread, ViewerError>> = OnceLock::new();
/// Flights of all windows, which the end of the connection closes.
static OPEN: Mutex<Vec<Weak<Shared>>> = Mutex::new(Vec::new());

/// True after the connection to the display has ended.
static DISCONNECTED: AtomicBool = AtomicBool::new(false);

/// Returns true after the connection to the display has ended.
fn is_disconnected() -> bool {
    DISCONNECTED.load(Ordering::SeqCst)
}

/// Returns true if the process has connected to a display. The thread of the windows then runs until the process ends.
///
/// A window whose display has ended may hold resources of OpenGL: the end of the process can crash in the destructors
/// of OpenGL, unless the process ends without destructors (`_exit`).
pub fn has_thread() -> bool {
    matches!(THREAD.get(), Some(Ok(_)))
}

/// Opens a window.
pub(crate) fn open(shared: Arc<Shared>, options: ViewerOptions) -> Result<(), ViewerError> {
    let thread = THREAD.get_or_init(start).as_ref().map_err(Clone::clone)?;
    if thread.process != std::process::id() {
        return Err(ViewerError::Forked);
    }
    let mut open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
    open.retain(|open| open.strong_count() > 0);
    open.push(Arc::downgrade(&shared));
    drop(open);
    if is_disconnected() {
        return Err(ViewerError::Disconnected);
    }
    let (answer, answered) = mpsc::sync_channel(1);
    thread.send(Message::Open(shared.clone(), options, answer))?;
    // the thread closes the flight instead of an answer if the connection breaks meanwhile
    loop {
        match answered.recv_timeout(Duration::from_millis(100)) {
            Ok(answer) => return answer,
            Err(mpsc::RecvTimeoutError::Disconnected) => return Err(ViewerError::Disconnected),
            Err(mpsc::RecvTimeoutError::Timeout) => {
                if let Some(error) = shared.state().error.take() {
                    return Err(error);
                }
            }
        }
    }
}

/// Checks that a window can be opened: connects to the display and creates an invisible window with OpenGL.
///
/// # Errors
/// As for [`Viewer::open`](crate::Viewer::open).
pub fn check_display() -> Result<(), ViewerError> {
    let thread = THREAD.get_or_init(start).as_ref().map_err(Clone::clone)?;
    if thread.process != std::process::id() {
        return Err(ViewerError::Forked);
    }
    let (answer, answered) = mpsc::sync_channel(1);
    thread.send(Message::Check(answer))?;
    loop {
        match answered.recv_timeout(Duration::from_millis(100)) {
            Ok(answer) => return answer,
            // the thread may have stopped for ever
            Err(mpsc::RecvTimeoutError::Timeout) if !is_disconnected() => {}
            Err(_) => return Err(ViewerError::Disconnected),
        }
    }
}

/// Waits until a closed window has released its resources, at most a second.
///
/// The end of a process unloads OpenGL, which crashes the process if the window still draws.
pub(crate) fn wait_for_end(shared: &Shared) {
    let is_own = matches!(THREAD.get(), Some(Ok(thread)) if thread.process == std::process::id());
    let begin = Instant::now();
    while is_own && shared.has_window() && !is_disconnected() && begin.elapsed() < Duration::from_secs(1) {
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Tells the windows that a flight has changed.
pub(crate) fn wake() {
    if let Some(Ok(thread)) = THREAD.get()
        && thread.process == std::process::id()
    {
        // a thread that has ended has closed its windows
        let _ = thread.send(Message::Changed);
    }
}

/// Longest time that the end of the process waits for the windows.
const LONGEST_END: Duration = Duration::from_secs(5);

/// Closes all windows of the process and waits until their thread has released their resources.
///
/// Call it before the process ends: exit handlers of OpenGL drivers destroy objects that a window may still draw with.
pub fn close_windows() {
    let Some(Ok(thread)) = THREAD.get() else { return };
    if thread.process != std::process::id() || is_disconnected() {
        return;
    }
    let (answer, answered) = mpsc::sync_channel(1);
    if thread.send(Message::CloseAll(answer)).is_ok() {
        // a display that hangs does not keep the process
        let _ = answered.recv_timeout(LONGEST_END);
    }
}

impl WindowThread {
    fn send(&self, message: Message) -> Result<(), ViewerError> {
        let proxy = self.proxy.lock().unwrap_or_else(PoisonError::into_inner);
        proxy.send_event(message).map_err(|_| ViewerError::Disconnected)
    }
}

/// Starts the thread and connects to the display.
fn start() -> Result<WindowThread, ViewerError> {
    let (answer, answered) = mpsc::sync_channel(1);
    quieten_panics();
    let run = move || {
        IS_WINDOW_THREAD.set(true);
        let built = catch_unwind(|| EventLoop::with_user_event().with_any_thread_everywhere().build());
        let event_loop: EventLoop<Message> = match built {
            Ok(Ok(event_loop)) => event_loop,
            Ok(Err(error)) => {
                let _ = answer.send(Err(ViewerError::no_display(&error.to_string())));
                return;
            }
            Err(_) => {
                let _ = answer.send(Err(ViewerError::no_display("the display libraries failed")));
                return;
            }
        };
        x11::watch(&event_loop, disconnect_all);
        let _ = answer.send(Ok(event_loop.create_proxy()));
        let mut windows = Windows::default();
        // a panic of the display libraries, which do not expect the end of a connection, ends the windows and no flight
        let ran = catch_unwind(AssertUnwindSafe(|| event_loop.run_app(&mut windows)));
        if let Err(panic) = ran {
            // the thread that waits for the end of the connection may be late
            std::thread::sleep(Duration::from_millis(200));
            if !is_disconnected() {
                let text = panic.downcast_ref::<String>().map(String::as_str);
                let text = text.or(panic.downcast_ref::<&str>().copied()).unwrap_or("unknown cause");
                close_all(&ViewerError::Scene { reason: format!("the window panicked: {text}") });
            }
        }
        disconnect_all();
        // the resources of the display may be unusable
        std::mem::forget(windows);
    };
    let thread = std::thread::Builder::new().name("viewer".into()).spawn(run);
    thread.map_err(|error| ViewerError::no_display(&error.to_string()))?;
    let proxy = answered.recv().map_err(|_| ViewerError::no_display("the thread of the window ended"))??;
    Ok(WindowThread { proxy: Mutex::new(proxy), process: std::process::id() })
}

thread_local! {
    /// True on the thread of the windows.
    static IS_WINDOW_THREAD: Cell<bool> = const { Cell::new(false) };
}

/// Prints no message of a panic on the thread of the windows: it becomes a [`ViewerError`].
fn quieten_panics() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if !IS_WINDOW_THREAD.get() {
            before(panic);
        }
    }));
}

/// Closes all flights because the connection has ended, and refuses new windows.
fn disconnect_all() {
    DISCONNECTED.store(true, Ordering::SeqCst);
    close_all(&ViewerError::Disconnected);
}

/// Closes all flights with an error.
fn close_all(error: &ViewerError) {
    for shared in OPEN.lock().unwrap_or_else(PoisonError::into_inner).drain(..).filter_map(|open| open.upgrade()) {
        let is_open = shared.state().is_open;
        if is_open {
            shared.close(Some(error.clone()));
        }
    }
}

/// Allows the event loop of either display on a thread that is not the main thread.
trait AnyThread {
    fn with_any_thread_everywhere(&mut self) -> &mut Self;
}

impl AnyThread for winit::event_loop::EventLoopBuilder<Message> {
    fn with_any_thread_everywhere(&mut self) -> &mut Self {
        winit::platform::x11::EventLoopBuilderExtX11::with_any_thread(self, true);
        winit::platform::wayland::EventLoopBuilderExtWayland::with_any_thread(self, true)
    }
}

/// All windows.
#[derive(Default)]
struct Windows {
    windows: HashMap<WindowId, ViewWindow>,
}

impl Windows {
    fn open(
        &mut self,
        event_loop: &ActiveEventLoop,
        shared: Arc<Shared>,
        options: &ViewerOptions,
    ) -> Result<(), ViewerError> {
        let window = ViewWindow::new(event_loop, shared, options)?;
        window.shared().set_has_window(true);
        self.windows.insert(window.id(), window);
        Ok(())
    }
}

/// Ends a window.
fn end(window: ViewWindow) {
    if is_disconnected() {
        // the end of the resources would use the connection
        std::mem::forget(window);
    } else {
        let shared = window.shared().clone();
        window.finish();
        shared.set_has_window(false);
    }
}

impl ApplicationHandler<Message> for Windows {
    fn resumed(&mut self, _: &ActiveEventLoop) {}

    fn user_event(&mut self, event_loop: &ActiveEventLoop, message: Message) {
        match message {
            Message::Open(shared, options, answer) => {
                let opened = self.open(event_loop, shared.clone(), &options);
                if opened.is_err() {
                    shared.close(None);
                }
                let _ = answer.send(opened);
            }
            Message::Check(answer) => {
                let attributes = WindowAttributes::default().with_visible(false);
                let _ = answer.send(GlWindow::new(event_loop, attributes).map(|_| ()));
            }
            Message::Changed => self.windows.values_mut().for_each(ViewWindow::mark_changed),
            Message::CloseAll(answer) => {
                self.windows.drain().for_each(|(_, window)| end(window));
                let _ = answer.send(());
            }
        }
    }

    fn window_event(&mut self, _: &ActiveEventLoop, id: WindowId, event: WindowEvent) {
        if let Some(window) = self.windows.get_mut(&id) {
            window.event(&event);
        }
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        let mut next: Option<Instant> = None;
        let mut closed = Vec::new();
        for (id, window) in &mut self.windows {
            if window.is_closed() {
                closed.push(*id);
                continue;
            }
            if let Some(due) = window.due() {
                let due = if due <= Instant::now() {
                    window.draw();
                    if window.is_closed() {
                        closed.push(*id);
                        continue;
                    }
                    window.due()
                } else {
                    Some(due)
                };
                next = next.into_iter().chain(due).min();
            }
        }
        for id in closed {
            self.windows.remove(&id).into_iter().for_each(end);
        }
        event_loop.set_control_flow(next.map_or(ControlFlow::Wait, ControlFlow::WaitUntil));
    }
}
