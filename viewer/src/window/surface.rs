//! One window: events, panels and the image of the scene.

use std::sync::Arc;
use std::time::{Duration, Instant};

use egui_winit::State as EguiState;
use winit::dpi::PhysicalSize;
use winit::event::WindowEvent;
use winit::event_loop::ActiveEventLoop;
use winit::window::{WindowAttributes, WindowId};

use super::gl::GlWindow;
use super::priority;
use crate::error::ViewerError;
use crate::flight::Flight;
use crate::recording::{Recording, Saver};
use crate::scene::{SceneImages, SceneView};
use crate::shared::Shared;
use crate::ui::{Ui, Wish};
use crate::viewer::ViewerOptions;

/// Shortest time between two images.
const IMAGE_PERIOD: Duration = Duration::from_micros(16_600);

/// Shortest time between two images of a window that leaves the processors to other work.
const BACKGROUND_PERIOD: Duration = Duration::from_millis(100);

/// Longest time between two images of such a window while the flight changes.
const LONGEST_BACKGROUND_PERIOD: Duration = Duration::from_secs(2);

/// Share of the time that such a window draws, as a divisor. A person at the mouse or the keys gets images earlier.
const BACKGROUND_DIVISOR: u32 = 60;

/// Time after an event of mouse or keys in which images come earlier.
const ATTENTION: Duration = Duration::from_millis(500);

pub(super) struct ViewWindow {
    // the painter is dropped by `finish`, which makes its context current
    painter: egui_glow::Painter,
    egui: EguiState,
    gl: GlWindow,
    shared: Arc<Shared>,
    flight: Flight,
    scene: SceneView,
    images: SceneImages,
    ui: Ui,
    saver: Saver,
    recording: Option<Recording>,
    /// Time at which egui wants to draw again.
    repaint: Option<Instant>,
    is_changed: bool,
    /// True for a window that leaves the processors to other work.
    in_background: bool,
    /// Start of the last image, and the time that it took.
    last: Option<(Instant, Duration)>,
    /// Time of the last event of mouse or keys.
    touched: Option<Instant>,
    /// Times of the last images.
    drawn: std::collections::VecDeque<Instant>,
    is_closed: bool,
}

impl ViewWindow {
    pub fn new(
        event_loop: &ActiveEventLoop,
        shared: Arc<Shared>,
        options: &ViewerOptions,
    ) -> Result<Self, ViewerError> {
        if options.in_background {
            priority::lower();
        }
        let flight = Flight::of(&shared);
        let scene = SceneView::new(&flight.episode.world, options.is_pretty)?;
        let size = options.size.map(|side| side.clamp(64, 8192));
        let attributes = WindowAttributes::default()
            .with_title(options.title.clone())
            .with_inner_size(PhysicalSize::new(size[0], size[1]));
        let gl = GlWindow::new(event_loop, attributes)?;
        let painter = gl.current(|| egui_glow::Painter::new(gl.gl.clone(), "", None, false));
        let painter = painter
            .map_err(|reason| ViewerError::NoGl { reason })?
            .map_err(|error| ViewerError::NoGl { reason: error.to_string() })?;
        let egui = EguiState::new(
            egui::Context::default(),
            egui::ViewportId::ROOT,
            event_loop,
            Some(gl.window.scale_factor() as f32),
            event_loop.system_theme(),
            Some(painter.max_texture_side()),
        );
        egui.egui_ctx().set_theme(egui::Theme::Dark);
        egui.egui_ctx().set_fonts(fonts());
        let mut ui = Ui::new(options, &flight);
        ui.is_pretty = scene.is_pretty;
        let saver = Saver::new(options.output.clone(), &flight.episode.task);
        Ok(Self {
            painter,
            egui,
            gl,
            shared,
            flight,
            scene,
            images: SceneImages::default(),
            ui,
            saver,
            recording: None,
            repaint: None,
            is_changed: true,
            in_background: options.in_background,
            last: None,
            touched: None,
            drawn: std::collections::VecDeque::new(),
            is_closed: false,
        })
    }

    /// Returns the state that the window shares with the flight.
    pub fn shared(&self) -> &Arc<Shared> {
        &self.shared
    }

    pub fn id(&self) -> WindowId {
        self.gl.window.id()
    }

    /// Notes that the flight has changed.
    pub fn mark_changed(&mut self) {
        self.is_changed = true;
    }

    pub fn event(&mut self, event: &WindowEvent) {
        match event {
            WindowEvent::CloseRequested | WindowEvent::Destroyed => self.is_closed = true,
            WindowEvent::Resized(size) => {
                let size = [size.width, size.height];
                // a failure appears in the next image, too
                let _ = self.gl.current(|| self.gl.resize(size));
                self.is_changed = true;
            }
            WindowEvent::RedrawRequested => self.is_changed = true,
            WindowEvent::CursorMoved { .. }
            | WindowEvent::MouseInput { .. }
            | WindowEvent::MouseWheel { .. }
            | WindowEvent::KeyboardInput { .. } => self.touched = Some(Instant::now()),
            _ => {}
        }
        if self.egui.on_window_event(&self.gl.window, event).repaint {
            self.is_changed = true;
        }
    }

    /// Returns true if the person or the flight has closed the window.
    pub fn is_closed(&self) -> bool {
        self.is_closed || !self.shared.state().is_open
    }

    /// Returns the time of the next image; `None` if nothing changes.
    pub fn due(&self) -> Option<Instant> {
        let now = Instant::now();
        let wanted = if self.is_changed { Some(now) } else { self.repaint };
        let earliest = self.last.map_or(now, |(last, duration)| last + self.period(duration));
        wanted.map(|wanted| wanted.max(earliest))
    }

    /// Returns the shortest time between two images, of which the last took `duration`.
    fn period(&self, duration: Duration) -> Duration {
        if !self.in_background {
            IMAGE_PERIOD
        } else if self.touched.is_some_and(|touched| touched.elapsed() < ATTENTION) {
            BACKGROUND_PERIOD
        } else {
            (duration * BACKGROUND_DIVISOR).clamp(BACKGROUND_PERIOD, LONGEST_BACKGROUND_PERIOD)
        }
    }

    /// Draws an image. An error closes the window.
    pub fn draw(&mut self) {
        let size = self.gl.window.inner_size();
        self.is_changed = false;
        self.repaint = None;
        let start = Instant::now();
        self.last = Some((start, Duration::ZERO));
        if size.width == 0 || size.height == 0 || self.is_closed() {
            // later changes must wake the window
            self.shared.read();
            return;
        }
        if let Err(error) = self.draw_image([size.width, size.height]) {
            self.shared.close(Some(error));
        }
        self.last = Some((start, start.elapsed()));
    }

    fn draw_image(&mut self, size: [u32; 2]) -> Result<(), ViewerError> {
        self.flight.update(&self.shared);
        let input = self.egui.take_egui_input(&self.gl.window);
        let context = self.egui.egui_ctx().clone();
        let Self { ui, flight, images, scene, .. } = self;
        ui.prepare(flight);
        scene.draw(&context, flight, ui, images)?;
        let output = context.run_ui(input, |root| ui.show(root, flight, images));
        self.egui.handle_platform_output(&self.gl.window, output.platform_output);
        let delay = output.viewport_output.get(&egui::ViewportId::ROOT).map(|viewport| viewport.repaint_delay);
        self.repaint = delay.and_then(|delay| Instant::now().checked_add(delay));
        let primitives = context.tessellate(output.shapes, output.pixels_per_point);
        let mut textures = output.textures_delta;
        let (painter, gl) = (&mut self.painter, &self.gl);
        let wants_pixels = self.ui.wants_image() || self.recording.as_ref().is_some_and(Recording::is_due);
        let drawn = gl.current(|| {
            painter.clear(size, [0.08, 0.09, 0.11, 1.0]);
            painter.paint_and_update_textures(size, output.pixels_per_point, &primitives, &mut textures);
            let pixels = wants_pixels.then(|| painter.read_screen_rgba(size));
            if super::is_disconnected() { Err("disconnected".into()) } else { gl.swap().map(|()| pixels) }
        });
        // textures remain without a context, and egui insists that they are removed
        textures.clear();
        let pixels = drawn.and_then(|drawn| drawn).map_err(|reason| {
            if super::is_disconnected() { ViewerError::Disconnected } else { ViewerError::Scene { reason } }
        })?;
        if let Some(pixels) = pixels {
            self.save(&pixels);
        }
        self.obey();
        self.report(size);
        Ok(())
    }

    /// Saves an image or adds it to the animation.
    fn save(&mut self, pixels: &egui::ColorImage) {
        if std::mem::take(&mut self.ui.save_image) {
            let saved = self.saver.image(pixels);
            self.ui.notify(saved);
        }
        if let Some(recording) = &mut self.recording
            && let Err(error) = recording.add(pixels)
        {
            self.recording = None;
            self.ui.notify(Err(error));
        }
    }

    /// Executes the wishes of the person that concern the window.
    fn obey(&mut self) {
        for wish in std::mem::take(&mut self.ui.wishes) {
            match wish {
                Wish::Flight(command) => self.shared.send(command),
                Wish::Record(kind) => match self.recording.take() {
                    Some(recording) => {
                        let saved = recording.finish();
                        self.ui.notify(saved);
                    }
                    None => {
                        let size = self.gl.window.inner_size();
                        match self.saver.recording(kind, [size.width, size.height]) {
                            Ok(recording) => self.recording = Some(recording),
                            Err(error) => self.ui.notify(Err(error)),
                        }
                    }
                },
                Wish::Quality(is_pretty) => {
                    match SceneView::new(&self.flight.episode.world, Some(is_pretty)) {
                        Ok(scene) => self.scene = scene,
                        Err(error) => self.ui.notify(Err(error.to_string())),
                    }
                    self.ui.is_pretty = self.scene.is_pretty;
                }
                Wish::Close => self.is_closed = true,
            }
            self.is_changed = true;
        }
        if self.recording.is_some() {
            let next = Instant::now() + Duration::from_secs_f64(Recording::SECONDS_PER_FRAME);
            self.repaint = Some(self.repaint.map_or(next, |repaint| repaint.min(next)));
        }
    }

    /// Reports the state of the window to the flight.
    fn report(&mut self, size: [u32; 2]) {
        let now = Instant::now();
        self.drawn.push_back(now);
        while self.drawn.front().is_some_and(|&first| now - first > Duration::from_secs(1)) {
            self.drawn.pop_front();
        }
        let mut state = self.shared.state();
        let status = &mut state.status;
        status.size = size;
        status.images += 1;
        status.images_per_second = self.drawn.len() as f64;
        status.is_recording = self.recording.is_some();
        self.ui.report(status, &self.flight);
        self.ui.is_recording = status.is_recording;
        self.ui.images_per_second = status.images_per_second;
    }

    /// Closes the window. The flight gets the error of an animation that cannot be completed.
    pub fn finish(mut self) {
        let saved = self.recording.take().map(Recording::finish);
        let error = saved.and_then(Result::err).map(|reason| ViewerError::Recording { reason });
        let painter = &mut self.painter;
        // the resources end with the context if it cannot become current
        let _ = self.gl.current(|| painter.destroy());
        self.shared.close(error);
    }
}

/// Returns the fonts of the panels.
fn fonts() -> egui::FontDefinitions {
    let families = [
        (egui::FontFamily::Proportional, "sans", dejavu::sans::regular()),
        (egui::FontFamily::Monospace, "mono", dejavu::sans_mono::regular()),
    ];
    let mut fonts = egui::FontDefinitions::empty();
    for (family, name, bytes) in families {
        fonts.font_data.insert(name.into(), Arc::new(egui::FontData::from_static(bytes)));
        fonts.families.insert(family, vec![name.into()]);
    }
    fonts
}
