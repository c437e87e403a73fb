//! Adapters of the machine, and a connection to one of them.

use std::sync::{Mutex, PoisonError};

use cubecl::client::Client;
use cubecl::ir::{ElemType, FloatKind};
use cubecl::wgpu::{AutoGraphicsApi, RuntimeOptions, WgpuBackend, WgpuDevice, WgpuDeviceKind};

use crate::error::{GpuError, one_line};

/// Kind of an adapter.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum AdapterKind {
    /// GPU with its own memory.
    Discrete,
    /// GPU that shares the memory of the CPU.
    Integrated,
    /// GPU of a virtual machine.
    Virtual,
    /// Unknown.
    Other,
    /// Software on the CPU, such as Mesa's lavapipe.
    Cpu,
}

impl std::fmt::Display for AdapterKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(match self {
            Self::Discrete => "discrete GPU",
            Self::Integrated => "integrated GPU",
            Self::Virtual => "virtual GPU",
            Self::Other => "unknown kind",
            Self::Cpu => "software on the CPU",
        })
    }
}

/// GPU, or software that implements the interface of one.
#[derive(Debug, Clone, PartialEq)]
pub struct Adapter {
    /// Name of the device.
    pub name: String,
    /// Kind of the device.
    pub kind: AdapterKind,
    /// Programming interface: Vulkan, Metal.
    pub api: String,
    /// Name and version of the driver.
    pub driver: String,
    /// True if the device computes in double precision.
    pub double: bool,
    /// Largest buffer, bytes.
    pub max_buffer: u64,
    /// Identifier of the device in the runtime.
    device: WgpuDevice,
}

impl std::fmt::Display for Adapter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let precision = if self.double { "single and double precision" } else { "single precision" };
        let Self { name, kind, api, driver, .. } = self;
        write!(f, "{name} ({kind}, {api}, {driver}, {precision})")
    }
}

#[cfg(feature = "vulkan")]
const API: (wgpu::Backends, WgpuBackend, &str) = (wgpu::Backends::VULKAN, WgpuBackend::Vulkan, "Vulkan");
#[cfg(all(feature = "metal", not(feature = "vulkan")))]
const API: (wgpu::Backends, WgpuBackend, &str) = (wgpu::Backends::METAL, WgpuBackend::Metal, "Metal");
#[cfg(not(any(feature = "vulkan", feature = "metal")))]
const API: (wgpu::Backends, WgpuBackend, &str) = (wgpu::Backends::VULKAN, WgpuBackend::Vulkan, "Vulkan");

/// Number of buffers of the largest kernel: nine of the step, and those of the runtime.
const BINDINGS: u32 = 12;

/// Devices of which the runtime has a connection. The lock also keeps the instances of the programming interface on one
/// thread at a time: the Vulkan loader crashes if several threads create and drop them.
static OPEN: Mutex<Vec<WgpuDevice>> = Mutex::new(Vec::new());

/// Returns the adapters of the machine, the fastest kinds first; an empty list without a driver.
pub fn adapters() -> Vec<Adapter> {
    let _instances = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
    list()
}

fn list() -> Vec<Adapter> {
    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
        backends: API.0,
        ..wgpu::InstanceDescriptor::new_without_display_handle()
    });
    let found = cubecl::future::block_on(instance.enumerate_adapters(API.0));
    // the runtime counts the devices of every kind
    let mut counts = [0; 4];
    let mut next = |kind: usize| {
        counts[kind] += 1;
        counts[kind] - 1
    };
    let mut adapters: Vec<_> = found
        .iter()
        .map(|adapter| {
            let info = adapter.get_info();
            let (kind, device) = match info.device_type {
                wgpu::DeviceType::DiscreteGpu => (AdapterKind::Discrete, WgpuDeviceKind::DiscreteGpu(next(0))),
                wgpu::DeviceType::IntegratedGpu => (AdapterKind::Integrated, WgpuDeviceKind::IntegratedGpu(next(1))),
                wgpu::DeviceType::VirtualGpu => (AdapterKind::Virtual, WgpuDeviceKind::VirtualGpu(next(2))),
                wgpu::DeviceType::Cpu => (AdapterKind::Cpu, WgpuDeviceKind::Cpu),
                wgpu::DeviceType::Other => (AdapterKind::Other, WgpuDeviceKind::Other(next(3))),
            };
            let limits = adapter.limits();
            Adapter {
                name: info.name,
                kind,
                api: API.2.into(),
                driver: format!("{} {}", info.driver, info.driver_info).trim().into(),
                double: cfg!(feature = "vulkan") && adapter.features().contains(wgpu::Features::SHADER_F64),
                max_buffer: limits.max_storage_buffer_binding_size.min(limits.max_buffer_size),
                device: WgpuDevice::new(device).on(API.1),
            }
        })
        .collect();
    adapters.sort_by_key(|adapter| adapter.kind);
    adapters
}

/// Connection to an adapter.
///
/// ```
/// use aviary_gpu::{GpuDevice, GpuError};
///
/// match GpuDevice::open(None) {
///     Ok(device) => println!("{}", device.adapter()),
///     Err(GpuError::NoAdapter { .. }) => println!("this machine has no GPU"),
///     Err(error) => return Err(error),
/// }
/// # Ok::<(), GpuError>(())
/// ```
#[derive(Clone)]
pub struct GpuDevice {
    adapter: Adapter,
    client: Client,
}

impl std::fmt::Debug for GpuDevice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("GpuDevice").field("adapter", &self.adapter).finish_non_exhaustive()
    }
}

impl GpuDevice {
    /// Opens an adapter: the one whose index in [`adapters`] or part of whose name is `choice`, and the first one
    /// without a choice.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`], [`GpuError::UnknownAdapter`], and [`GpuError::Open`] if the driver refuses, or has too
    /// few buffers for a kernel.
    pub fn open(choice: Option<&str>) -> Result<Self, GpuError> {
        let mut open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
        let mut adapters = list();
        if adapters.is_empty() {
            return Err(GpuError::NoAdapter { api: API.2 });
        }
        let chosen = choice.map_or(Some(0), |choice| choose(&adapters, choice));
        let Some(index) = chosen else {
            let adapters = adapters.iter().enumerate().map(|(index, adapter)| format!("{index} ({})", adapter.name));
            return Err(GpuError::UnknownAdapter {
                got: choice.unwrap_or_default().into(),
                adapters: adapters.collect(),
            });
        };
        let mut adapter = adapters.swap_remove(index);
        if !open.contains(&adapter.device) {
            let setup = cubecl::wgpu::try_init_setup::<AutoGraphicsApi>(&adapter.device, RuntimeOptions::default());
            let setup = match setup {
                Ok(setup) => setup,
                Err(error) => {
                    let message = one_line(&error);
                    return Err(GpuError::Open { adapter: adapter.name, message });
                }
            };
            open.push(adapter.device.clone());
            #[cfg(test)]
            tests::keep(setup.device);
            #[cfg(not(test))]
            drop(setup);
        }
        let client = cubecl::Device::Wgpu(adapter.device.clone()).client();
        let properties = client.properties();
        let bindings = properties.hardware.max_bindings;
        if bindings < BINDINGS {
            let message = format!("its kernels have at most {bindings} buffers, expected {BINDINGS} or more");
            return Err(GpuError::Open { adapter: adapter.name, message });
        }
        adapter.double &= properties.supports_type(ElemType::Float(FloatKind::F64));
        adapter.max_buffer = properties.memory.max_page_size;
        Ok(Self { adapter, client })
    }

    /// Returns the adapter.
    pub fn adapter(&self) -> &Adapter {
        &self.adapter
    }

    /// Returns width and height of a grid of at least a number of workgroups, with few more than that.
    pub(crate) fn grid(&self, groups: usize) -> [u32; 2] {
        grid(groups, self.client.properties().hardware.max_cube_count.0 as usize)
    }

    /// Returns the device in the runtime.
    #[cfg(feature = "burn")]
    pub(crate) fn cube(&self) -> cubecl::Device {
        cubecl::Device::Wgpu(self.adapter.device.clone())
    }

    /// Returns the connection of the runtime.
    pub(crate) fn client(&self) -> &Client {
        &self.client
    }
}

/// Returns width and height of a grid of at least a number of workgroups, with a largest width.
fn grid(groups: usize, max: usize) -> [u32; 2] {
    let groups = groups.max(1);
    let height = groups.div_ceil(max);
    [groups.div_ceil(height), height].map(|length| length as u32)
}

/// Returns the adapter with an index or with a part of a name.
fn choose(adapters: &[Adapter], choice: &str) -> Option<usize> {
    let by_index = choice.parse().ok().filter(|index| *index < adapters.len());
    let name = choice.to_lowercase();
    by_index.or_else(|| adapters.iter().position(|adapter| adapter.name.to_lowercase().contains(&name)))
}

/// Opens the first adapter for a test of this crate; `None` without one, unless `AVIARY_REQUIRE_GPU` is set.
#[cfg(test)]
pub(crate) fn for_tests() -> Option<GpuDevice> {
    match GpuDevice::open(None) {
        Err(GpuError::NoAdapter { .. }) if std::env::var_os("AVIARY_REQUIRE_GPU").is_none() => None,
        device => Some(device.expect("an adapter that opens")),
    }
}

#[cfg(test)]
mod tests {
    use std::process::Command;
    use std::sync::Mutex;

    use aviary::env::EnvConfig;
    use aviary::vector::{VecBuffers, VecConfig, VecEnv as _};

    use super::{for_tests, grid};
    use crate::batch::{GpuAviary, Precision};

    /// Opened devices, which a test can take away.
    static DEVICES: Mutex<Vec<wgpu::Device>> = Mutex::new(Vec::new());

    pub fn keep(device: wgpu::Device) {
        DEVICES.lock().unwrap().push(device);
    }

    /// Runs in a process of its own, whose other tests would have no device.
    #[test]
    #[ignore = "run by a_destroyed_device_is_an_error_of_one_line"]
    fn destroy_the_device() {
        let Some(device) = for_tests() else { return };
        let options = EnvConfig::default();
        let mut env = GpuAviary::make("hover", options, VecConfig::new(4), &device, Precision::Single).unwrap();
        let mut buffers = VecBuffers::new(&env);
        env.reset(Some(1), &mut buffers.observations).unwrap();
        env.step(&[0.0; 16], buffers.step()).unwrap();
        DEVICES.lock().unwrap().iter().for_each(wgpu::Device::destroy);
        for _ in 0..2 {
            let error = env.step(&[0.0; 16], buffers.step()).unwrap_err().to_string();
            assert!(error.starts_with("the GPU failed: ") && !error.contains('\n'), "{error}");
        }
    }

    #[test]
    fn a_destroyed_device_is_an_error_of_one_line() {
        let program = std::env::current_exe().unwrap();
        let arguments = ["--exact", "device::tests::destroy_the_device", "--ignored"];
        let output = Command::new(program).args(arguments).output().unwrap();
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success() && text.contains("1 passed"), "{text}");
    }

    #[test]
    fn a_grid_has_few_workgroups_more_than_it_needs() {
        assert_eq!(grid(0, 65_535), [1, 1]);
        assert_eq!(grid(65_535, 65_535), [65_535, 1]);
        assert_eq!(grid(65_536, 65_535), [32_768, 2]);
        for groups in [1, 7, 100, 65_537, 131_071, 1 << 20, (1 << 24) + 1] {
            let [width, height] = grid(groups, 65_535).map(|length| length as usize);
            assert!(width <= 65_535 && (groups..groups + height).contains(&(width * height)), "{groups}");
        }
    }
}
