use std::process::Command;

use anyhow::{Context as _, anyhow};
use clap::Args;
use mujoco_rs::{Camera, Data, Error, GlBackend, ImageSize, Model, Quality, Renderer, Scene};
use serde_json::{Value, json};
use viewer::ViewerError;

use crate::failure::Failure;
use crate::output;

/// Check the libraries that the program needs
///
/// The exit status is 1 if MuJoCo does not work or if neither OpenGL library (EGL, OSMesa) can
/// render; the error has the command that installs the packages. ffmpeg and a display are
/// optional: only --video needs ffmpeg, only `aviary view` and --view need a display.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
#[command(after_help = "Examples:
  aviary doctor
  MUJOCO_GL=osmesa aviary doctor")]
pub struct Doctor {
    /// JSON output instead of a table
    #[arg(long)]
    json: bool,
    /// Rendering test of the library that MUJOCO_GL names, in a process that doctor starts
    #[arg(long, hide = true)]
    probe: bool,
}

/// Outcome of one check.
struct Check {
    name: &'static str,
    works: bool,
    /// Version or device; the reason if the check fails.
    detail: String,
    /// Debian packages that fix a failed check.
    packages: Option<String>,
}

impl Check {
    fn install(&self) -> Option<String> {
        self.packages.as_ref().map(|packages| format!("apt-get install {packages}"))
    }

    fn json(&self) -> Value {
        json!({ "works": self.works, "detail": self.detail, "install": self.install() })
    }

    /// Returns the rows of the table: the state, and the fix below it.
    fn rows(&self) -> impl Iterator<Item = (&'static str, String)> {
        let state = if self.works { "works" } else { "no" };
        let fix = self.install().map(|command| ("", format!("fix: {command}")));
        std::iter::once((self.name, format!("{state} ({})", self.detail))).chain(fix)
    }
}

impl Doctor {
    pub fn run(&self) -> Result<(), Failure> {
        if self.probe {
            return output::print_json(&probe());
        }
        let checked = mujoco_rs::check_library();
        let [major, minor, patch] = mujoco_rs::library_version();
        let version = format!("{major}.{minor}.{patch}");
        let libraries = GlBackend::ALL.map(|backend| ask(backend.name(), Some(backend)));
        // the library of all other commands, chosen by MUJOCO_GL and MUJOCO_EGL_DEVICE_ID
        let drawing = ask("OpenGL", None);
        let ffmpeg = ffmpeg();
        let window = window();
        let gpus = gpus();
        let ok = checked.is_ok() && drawing.works;

        if self.json {
            let gl: Vec<_> = (GlBackend::ALL.iter().zip(&libraries))
                .map(|(backend, check)| {
                    let mut json = check.json();
                    json["backend"] = backend.name().into();
                    json
                })
                .collect();
            let mut json = json!({
                "mujoco_version": version,
                "gl": gl,
                "ffmpeg": ffmpeg.json(),
                "window": window.json(),
                "ok": ok,
            });
            if cfg!(feature = "gpu") {
                json["gpus"] = gpus.iter().map(Check::json).collect();
            }
            output::print_json(&json)?;
        } else {
            let (works, detail) = match &checked {
                Ok(()) => (true, version),
                Err(error) => (false, error.to_string()),
            };
            let mujoco = Check { name: "MuJoCo", works, detail, packages: None };
            let checks = [&mujoco].into_iter().chain(&libraries).chain([&ffmpeg, &window]).chain(&gpus);
            let rows: Vec<_> = checks.flat_map(Check::rows).collect();
            output::print(&output::table(&rows))?;
        }
        checked.map_err(|error| Failure::work(anyhow!("{error}: run `./setup` and build again")))?;
        match (&drawing.works, drawing.install()) {
            (true, _) => Ok(()),
            // the reasons are in the table
            (false, Some(command)) => Err(Failure::work(anyhow!("no OpenGL library can render; fix: {command}"))),
            (false, None) => Err(Failure::work(anyhow!(drawing.detail))),
        }
    }
}

/// Checks one OpenGL library, or the one that the environment chooses, in a new process.
///
/// A process keeps the first library that works, so that each check needs its own process.
fn ask(name: &'static str, backend: Option<GlBackend>) -> Check {
    let tried = || {
        let program = std::env::current_exe().context("this program's own file")?;
        let mut command = Command::new(program);
        command.args(["doctor", "--probe"]);
        if let Some(backend) = backend {
            command.env("MUJOCO_GL", backend.name());
        }
        let output = command.output()?;
        // there is no answer if the driver ends the process
        serde_json::from_slice::<Value>(&output.stdout).map_err(|_| anyhow!("rendering ended with {}", output.status))
    };
    let answer = tried().unwrap_or_else(|error| json!({ "works": false, "detail": format!("{error:#}") }));
    let text = |key: &str| answer[key].as_str().map(str::to_string);
    Check {
        name,
        works: answer["works"] == true,
        detail: text("detail").unwrap_or_default(),
        packages: text("packages"),
    }
}

/// Returns the result of the rendering test as JSON.
fn probe() -> Value {
    match draw() {
        Ok(device) => json!({ "works": true, "detail": device }),
        Err(error) => match error.downcast_ref() {
            Some(Error::NoGl { attempts }) => {
                let reasons: Vec<_> = attempts.iter().map(|attempt| &*attempt.answer).collect();
                let packages: Vec<_> = attempts.iter().map(|attempt| attempt.backend.packages()).collect();
                json!({ "works": false, "detail": reasons.join("; "), "packages": packages.join(" ") })
            }
            _ => json!({ "works": false, "detail": error.to_string() }),
        },
    }
}

/// Lists the adapters that `aviary-gpu` can use, in the order of their indices.
#[cfg(feature = "gpu")]
fn gpus() -> Vec<Check> {
    let adapters = aviary_gpu::adapters();
    if adapters.is_empty() {
        let (detail, packages) = ("no adapter of Vulkan".into(), Some("mesa-vulkan-drivers".into()));
        return vec![Check { name: "GPU", works: false, detail, packages }];
    }
    let check = |(index, adapter): (usize, &aviary_gpu::Adapter)| Check {
        name: "GPU",
        works: true,
        detail: format!("{index}: {adapter}"),
        packages: None,
    };
    adapters.iter().enumerate().map(check).collect()
}

/// Returns no adapters: the program was built without the feature `gpu`.
#[cfg(not(feature = "gpu"))]
fn gpus() -> Vec<Check> {
    Vec::new()
}

/// Checks the display, which `view` and `--view` need.
fn window() -> Check {
    let (works, detail, packages) = match viewer::check_display() {
        Ok(()) => (true, "a display with OpenGL".to_string(), None),
        Err(error) => {
            let is_library = matches!(error, ViewerError::NoGl { .. }) || error.to_string().contains("apt-get");
            let reason = match &error {
                ViewerError::NoDisplay { reason } | ViewerError::NoGl { reason } => reason.clone(),
                _ => error.to_string(),
            };
            let packages = is_library.then(|| ViewerError::PACKAGES.to_string());
            (false, format!("{reason}; only `aviary view` and --view need a display"), packages)
        }
    };
    Check { name: "window", works, detail, packages }
}

/// Checks ffmpeg, which `--video` needs.
fn ffmpeg() -> Check {
    let missing = |detail: String| Check {
        name: "ffmpeg",
        works: false,
        detail: format!("{detail}; only --video needs it"),
        packages: Some("ffmpeg".into()),
    };
    match Command::new("ffmpeg").arg("-version").output() {
        Ok(output) if output.status.success() => {
            let text = String::from_utf8_lossy(&output.stdout);
            let version = text.split_whitespace().nth(2).unwrap_or("of an unknown version").to_string();
            Check { name: "ffmpeg", works: true, detail: version, packages: None }
        }
        Ok(output) => missing(format!("`ffmpeg -version` ended with {}", output.status)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => missing("not found".into()),
        Err(error) => missing(error.to_string()),
    }
}

/// Renders a ball, checks the image, and returns the name of the device.
fn draw() -> anyhow::Result<String> {
    let mut data = Data::new(Model::from_xml("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>")?)?;
    data.kinematics()?;
    let model = data.shared_model();
    let mut scene = Scene::new(model.clone(), 0)?;
    let camera = Camera::Free { lookat: [0.0; 3], distance: 4.0, azimuth: 0.0, elevation: 0.0 };
    scene.update(&mut data, &camera)?;
    let size = ImageSize { width: 9, height: 9 };
    let mut objects = vec![[0; 2]; size.pixels()];
    Renderer::new(model, Quality::FAST)?.segmentation(&mut scene, size, &mut objects)?;
    anyhow::ensure!(objects[40][1] == 0 && objects[0][1] == -1, "the image is wrong");
    Ok(mujoco_rs::gl_info()?.device)
}
