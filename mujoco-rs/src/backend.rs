use std::fmt;

/// A way to an OpenGL context.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum GlBackend {
    /// EGL: a GPU's driver, or Mesa's software rasteriser.
    Egl,
    /// Mesa's off-screen library, in software.
    Osmesa,
}

impl GlBackend {
    /// Both, in the order in which they are tried.
    pub const ALL: [Self; 2] = [Self::Egl, Self::Osmesa];

    /// The name that `MUJOCO_GL` has for it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Egl => "egl",
            Self::Osmesa => "osmesa",
        }
    }

    /// Debian's packages that bring it.
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
