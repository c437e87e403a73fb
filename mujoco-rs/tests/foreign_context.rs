//! Rendering next to another library that has an EGL context of its own on the thread.

#![expect(unsafe_code, reason = "calls EGL as another library does")]

use std::ffi::c_void;
use std::ptr;

use libloading::{Library, Symbol};
use mujoco_rs::{
    Camera, CameraId, Data, GlBackend, ImageSize, Model, Quality, Renderer, Scene, VisualEffects, gl_info,
};

type Pointer = *mut c_void;

const SCENE: &str = r#"
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="down" pos="0 0 2"/>
    <geom type="plane" size="5 5 0.1"/>
  </worldbody>
</mujoco>"#;

/// EGL as another program uses it: a display, and a context without a surface.
struct Other {
    library: Library,
    display: Pointer,
    context: Pointer,
}

impl Other {
    /// Creates the context and makes it current; `None` without EGL.
    fn new() -> Option<Self> {
        const SURFACELESS: u32 = 0x31DD;
        const OPENGL: u32 = 0x30A2;
        const NONE: i32 = 0x3038;
        const RENDERABLE_TYPE: i32 = 0x3040;
        const OPENGL_BIT: i32 = 8;
        const SURFACE_TYPE: i32 = 0x3033;
        // SAFETY: a system library, and functions with the types of EGL's registry.
        unsafe {
            let library = Library::new("libEGL.so.1").ok()?;
            let display_of: Symbol<'_, unsafe extern "C" fn(u32, Pointer, *const isize) -> Pointer> =
                library.get(b"eglGetPlatformDisplay\0").ok()?;
            let initialize: Symbol<'_, unsafe extern "C" fn(Pointer, *mut i32, *mut i32) -> u32> =
                library.get(b"eglInitialize\0").ok()?;
            let bind: Symbol<'_, unsafe extern "C" fn(u32) -> u32> = library.get(b"eglBindAPI\0").ok()?;
            let choose: Symbol<'_, unsafe extern "C" fn(Pointer, *const i32, *mut Pointer, i32, *mut i32) -> u32> =
                library.get(b"eglChooseConfig\0").ok()?;
            let create: Symbol<'_, unsafe extern "C" fn(Pointer, Pointer, Pointer, *const i32) -> Pointer> =
                library.get(b"eglCreateContext\0").ok()?;
            let display = display_of(SURFACELESS, ptr::null_mut(), ptr::null());
            if display.is_null() || initialize(display, ptr::null_mut(), ptr::null_mut()) == 0 {
                return None;
            }
            bind(OPENGL);
            let attributes = [SURFACE_TYPE, 0, RENDERABLE_TYPE, OPENGL_BIT, NONE];
            let (mut config, mut count) = (ptr::null_mut(), 0);
            choose(display, attributes.as_ptr(), &mut config, 1, &mut count);
            let context = create(display, config, ptr::null_mut(), ptr::null());
            let other = Self { library, display, context };
            (count == 1 && !context.is_null() && other.make_current(context)).then_some(other)
        }
    }

    fn make_current(&self, context: Pointer) -> bool {
        // SAFETY: as above; the context may be null.
        unsafe {
            let make: Symbol<'_, unsafe extern "C" fn(Pointer, Pointer, Pointer, Pointer) -> u32> =
                self.library.get(b"eglMakeCurrent\0").unwrap();
            make(self.display, ptr::null_mut(), ptr::null_mut(), context) == 1
        }
    }

    fn is_current(&self) -> bool {
        // SAFETY: as above.
        unsafe {
            let current: Symbol<'_, unsafe extern "C" fn() -> Pointer> =
                self.library.get(b"eglGetCurrentContext\0").unwrap();
            current() == self.context
        }
    }

    /// Returns the name of the renderer, which OpenGL answers only to a thread with a current context.
    fn answers(&self) -> bool {
        const GL_RENDERER: u32 = 0x1F01;
        // SAFETY: as above.
        unsafe {
            let address: Symbol<'_, unsafe extern "C" fn(*const i8) -> Pointer> =
                self.library.get(b"eglGetProcAddress\0").unwrap();
            let function = address(c"glGetString".as_ptr().cast());
            let get_string =
                std::mem::transmute::<Pointer, Option<unsafe extern "C" fn(u32) -> *const u8>>(function).unwrap();
            !get_string(GL_RENDERER).is_null()
        }
    }
}

/// Loading the library, creating a renderer, drawing and dropping the renderer each leave the other library's context
/// current.
#[test]
fn the_context_of_another_library_stays_current() {
    let Some(other) = Other::new() else { return };
    assert!(other.answers());
    let Ok(info) = gl_info() else { return };
    if info.backend != GlBackend::Egl {
        return;
    }
    assert!(other.is_current() && other.answers(), "after loading");
    let mut data = Data::new(Model::from_xml(SCENE).unwrap()).unwrap();
    data.forward().unwrap();
    let model = data.shared_model();
    let mut scene = Scene::new(model.clone(), 10).unwrap();
    scene.set_effects(VisualEffects::default());
    let camera = Camera::Fixed(data.model().find::<CameraId>("down").unwrap());
    scene.update(&mut data, &camera).unwrap();
    let size = ImageSize { width: 32, height: 24 };
    let mut rgb = vec![0; 3 * size.pixels()];
    let mut renderer = Renderer::new(model.clone(), Quality::FAST).unwrap();
    assert!(other.is_current() && other.answers(), "after creating a renderer");
    renderer.rgb(&mut scene, size, &mut rgb).unwrap();
    assert!(rgb.iter().any(|&byte| byte > 0), "the image is black");
    assert!(other.is_current() && other.answers(), "after drawing");
    drop(renderer);
    assert!(other.is_current() && other.answers(), "after dropping the renderer");
    // without a context before, none is left current
    assert!(other.make_current(ptr::null_mut()));
    let mut renderer = Renderer::new(model, Quality::FAST).unwrap();
    renderer.rgb(&mut scene, size, &mut rgb).unwrap();
    assert!(!other.is_current() && !other.answers());
}
