//! OpenGL in a window, by EGL.
#![allow(unsafe_code)]

use std::ffi::CString;
use std::num::NonZeroU32;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use egui_glow::glow;
use glutin::config::ConfigTemplateBuilder;
use glutin::context::{ContextApi, ContextAttributesBuilder, NotCurrentGlContext as _, PossiblyCurrentContext};
use glutin::display::{GetGlDisplay as _, GlDisplay as _};
use glutin::prelude::PossiblyCurrentGlContext as _;
use glutin::surface::{GlSurface as _, Surface, SurfaceAttributesBuilder, SwapInterval, WindowSurface};
use glutin_winit::{ApiPreference, DisplayBuilder};
use winit::event_loop::ActiveEventLoop;
use winit::raw_window_handle::HasWindowHandle as _;
use winit::window::{Window, WindowAttributes};

use crate::error::ViewerError;

/// Window with an OpenGL context. The context is current only during calls of [`current`](Self::current), because
/// MuJoCo draws with contexts of its own on the same thread.
pub(super) struct GlWindow {
    // dropped before the window
    surface: Surface<WindowSurface>,
    context: PossiblyCurrentContext,
    pub gl: Arc<glow::Context>,
    pub window: Window,
}

impl GlWindow {
    pub fn new(event_loop: &ActiveEventLoop, attributes: WindowAttributes) -> Result<Self, ViewerError> {
        let failed = |reason: String| ViewerError::NoGl { reason };
        let template = ConfigTemplateBuilder::new().with_alpha_size(8).with_depth_size(0).with_stencil_size(0);
        const NONE: &str = "it has no configuration for windows";
        let builder = DisplayBuilder::new()
            .with_preference(ApiPreference::PreferEgl)
            .with_window_attributes(Some(attributes.clone()));
        // the closure must return a configuration, also of an empty list
        let built = catch_unwind(AssertUnwindSafe(|| {
            builder.build(event_loop, template, |mut configs| configs.next().expect(NONE))
        }));
        let built = built.map_err(|_| failed(NONE.into()))?;
        let (window, config) = built.map_err(|error| failed(error.to_string()))?;
        let window = match window {
            Some(window) => window,
            None => glutin_winit::finalize_window(event_loop, attributes, &config)
                .map_err(|error| failed(error.to_string()))?,
        };
        let handle = window.window_handle().map_err(|error| failed(error.to_string()))?.as_raw();
        let display = config.display();
        let desktop = ContextAttributesBuilder::new().build(Some(handle));
        let embedded = ContextAttributesBuilder::new().with_context_api(ContextApi::Gles(None)).build(Some(handle));
        let size = window.inner_size();
        let side = |side: u32| NonZeroU32::new(side).unwrap_or(NonZeroU32::MIN);
        let attributes =
            SurfaceAttributesBuilder::<WindowSurface>::new().build(handle, side(size.width), side(size.height));
        // SAFETY: the handle is that of `window`, which outlives the context and the surface: they are dropped first.
        let (context, surface) = unsafe {
            let context = display
                .create_context(&config, &desktop)
                .or_else(|_| display.create_context(&config, &embedded))
                .map_err(|error| failed(error.to_string()))?;
            let surface =
                display.create_window_surface(&config, &attributes).map_err(|error| failed(error.to_string()))?;
            (context, surface)
        };
        let context = context.make_current(&surface).map_err(|error| failed(error.to_string()))?;
        // SAFETY: the context is current; its display finds the functions.
        let gl = unsafe {
            glow::Context::from_loader_function(|name| {
                CString::new(name).map_or(std::ptr::null(), |name| display.get_proc_address(&name).cast())
            })
        };
        // a display without vertical synchronization draws at the rate of the event loop
        let _ = surface.set_swap_interval(&context, SwapInterval::DontWait);
        Ok(Self { surface, context, gl: Arc::new(gl), window })
    }

    /// Runs work with the context current.
    pub fn current<T>(&self, work: impl FnOnce() -> T) -> Result<T, String> {
        self.context.make_current(&self.surface).map_err(|error| error.to_string())?;
        let done = work();
        self.context.make_not_current_in_place().map_err(|error| error.to_string())?;
        Ok(done)
    }

    /// Shows what was drawn. The context must be current.
    pub fn swap(&self) -> Result<(), String> {
        self.surface.swap_buffers(&self.context).map_err(|error| error.to_string())
    }

    /// Adapts the surface to the size of the window. The context must be current.
    pub fn resize(&self, [width, height]: [u32; 2]) {
        if let (Some(width), Some(height)) = (NonZeroU32::new(width), NonZeroU32::new(height)) {
            self.surface.resize(&self.context, width, height);
        }
    }
}
