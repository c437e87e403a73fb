use std::process::Command;

use anyhow::{Context as _, anyhow};
use clap::Args;
use mujoco_rs::{Camera, Data, Error, GlBackend, ImageSize, Model, Quality, Renderer, Scene};
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::output;

/// What the program needs from this machine, and whether it is there
///
/// Exit status 1 if something required is missing, with the command that installs it. A library for drawing and ffmpeg, which
/// writes videos, are reported where they are missing; drawing needs one of the two libraries, nothing else needs ffmpeg.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  aviary doctor
  MUJOCO_GL=osmesa aviary doctor")]
pub struct Doctor {
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    /// Draw with the library that MUJOCO_GL names and print the outcome as JSON: the process that doctor itself starts
    #[arg(long, hide = true)]
    probe: bool,
}

/// Outcome of one check.
struct Check {
    name: &'static str,
    works: bool,
    /// Version or device where it works, the reason where it does not.
    detail: String,
    /// Debian packages that bring it, where installing them is the remedy.
    packages: Option<String>,
}

impl Check {
    fn install(&self) -> Option<String> {
        self.packages.as_ref().map(|packages| format!("apt-get install {packages}"))
    }

    fn json(&self) -> Value {
        json!({ "works": self.works, "detail": self.detail, "install": self.install() })
    }

    /// Rows of the table: the state, and the remedy below it.
    fn rows(&self) -> impl Iterator<Item = (&'static str, String)> {
        let state = if self.works { "works" } else { "no" };
        let remedy = self.install().map(|command| ("", format!("to install it: {command}")));
        std::iter::once((self.name, format!("{state} ({})", self.detail))).chain(remedy)
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
        // the library that every other command uses: MUJOCO_GL and MUJOCO_EGL_DEVICE_ID count here
        let drawing = ask("OpenGL", None);
        let ffmpeg = ffmpeg();
        let ok = checked.is_ok() && drawing.works;

        if self.json {
            let gl: Vec<_> = (GlBackend::ALL.iter().zip(&libraries))
                .map(|(backend, check)| {
                    let mut json = check.json();
                    json["backend"] = backend.name().into();
                    json
                })
                .collect();
            output::print_json(&json!({ "mujoco_version": version, "gl": gl, "ffmpeg": ffmpeg.json(), "ok": ok }))?;
        } else {
            let (works, detail) = match &checked {
                Ok(()) => (true, version),
                Err(error) => (false, error.to_string()),
            };
            let mujoco = Check { name: "MuJoCo", works, detail, packages: None };
            let checks = [&mujoco].into_iter().chain(&libraries).chain([&ffmpeg]);
            let rows: Vec<_> = checks.flat_map(Check::rows).collect();
            output::print(&output::table(&rows))?;
        }
        checked.map_err(|error| Failure::work(anyhow!("{error}: run `./setup` and build again")))?;
        match (&drawing.works, drawing.install()) {
            (true, _) => Ok(()),
            // the reasons are in the table
            (false, Some(command)) => Err(Failure::work(anyhow!("nothing can draw on this machine: {command}"))),
            (false, None) => Err(Failure::work(anyhow!(drawing.detail))),
        }
    }
}

/// Draws with one library, or with the one that the environment chooses, in a process of its own: a process keeps the first
/// library that works.
fn ask(name: &'static str, backend: Option<GlBackend>) -> Check {
    let tried = || {
        let program = std::env::current_exe().context("this program's own file")?;
        let mut command = Command::new(program);
        command.args(["doctor", "--probe"]);
        if let Some(backend) = backend {
            command.env("MUJOCO_GL", backend.name());
        }
        let output = command.output()?;
        // a driver that ends the process leaves no answer
        serde_json::from_slice::<Value>(&output.stdout).map_err(|_| anyhow!("drawing ended with {}", output.status))
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

/// The answer of a process that draws.
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

/// The program that `--video` needs.
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

/// Draws a ball and looks whether it is there.
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
    anyhow::ensure!(objects[40][1] == 0 && objects[0][1] == -1, "it draws, but not what it was given");
    Ok(mujoco_rs::gl_info()?.device)
}
