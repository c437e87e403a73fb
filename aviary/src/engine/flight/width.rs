use pulp::WithSimd;

use super::LANES;
use crate::names::named_enum;

named_enum! {
    "instruction set"
    /// Instruction set of the flight kernel, narrowest first. The results are bit-identical for all of them.
    pub enum Width {
        /// Baseline of every machine: two numbers per instruction on x86-64.
        Portable = "portable",
        /// AVX2: four numbers per instruction.
        Avx2 = "avx2",
        /// AVX-512: eight numbers per instruction.
        Avx512 = "avx512",
    }
}

/// The widest instruction set of the machine.
impl Default for Width {
    fn default() -> Self {
        Self::best()
    }
}

impl Width {
    /// Returns the instruction sets that this machine supports, narrowest first.
    pub fn available() -> impl Iterator<Item = Self> {
        Self::ALL.into_iter().filter(|width| width.is_available())
    }

    /// Returns the widest instruction set that this machine supports.
    pub fn best() -> Self {
        Self::available().last().unwrap_or(Self::Portable)
    }

    /// Returns true if this machine supports the instruction set.
    pub fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => pulp::x86::V3::is_available(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => pulp::x86::V4::is_available(),
            #[cfg(not(target_arch = "x86_64"))]
            _ => false,
        }
    }

    /// Runs work on the first `count` lanes with this instruction set, or with the baseline if it is not available.
    /// On AVX-512, up to four lanes run in the lower halves of the registers, on which the machine executes twice as
    /// many instructions per cycle.
    #[inline]
    pub(crate) fn run<W: WithSimd>(self, count: usize, work: W) -> W::Output {
        #[cfg(target_arch = "x86_64")]
        match self {
            Self::Avx512 => {
                if let Some(simd) = pulp::x86::V4::try_new() {
                    if count <= LANES / 2 {
                        return simd.vectorize(InHalves(simd, work));
                    }
                    return pulp::Simd::vectorize(simd, work);
                }
            }
            Self::Avx2 => {
                if let Some(simd) = pulp::x86::V3::try_new() {
                    return pulp::Simd::vectorize(simd, work);
                }
            }
            Self::Portable => {}
        }
        work.with_simd(pulp::Scalar128b)
    }
}

/// Work on the lower halves of AVX-512's 32 registers.
#[cfg(target_arch = "x86_64")]
struct InHalves<W>(pulp::x86::V4, W);

#[cfg(target_arch = "x86_64")]
impl<W: WithSimd> pulp::NullaryFnOnce for InHalves<W> {
    type Output = W::Output;

    #[inline(always)]
    fn call(self) -> W::Output {
        let Self(simd, work) = self;
        work.with_simd(*simd)
    }
}
