use std::fmt;

/// Library that provides OpenGL contexts.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum GlBackend {
    /// EGL: a GPU driver, or Mesa's software rasterizer.
    Egl,
    /// OSMesa: Mesa's off-screen software renderer.
    Osmesa,
}

impl GlBackend {
    /// All backends, in the order of detection.
    pub const ALL: [Self; 2] = [Self::Egl, Self::Osmesa];

    /// Returns the value of `MUJOCO_GL` that selects this backend.
    pub fn name(self) -> &'static str {
        match self {
            Self::Egl => "egl",
            Self::Osmesa => "osmesa",
        }
    }

    /// Returns the Debian packages that provide this backend.
    pub fn packages(self) -> &'static str {
        match self {
            Self::Egl => "libegl1 libgl1-mesa-dri",
            Self::Osmesa => "libosmesa6",
        }
    }
}

impl fmt::Display for GlBackend {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
