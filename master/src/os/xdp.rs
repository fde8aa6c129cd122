//! AF_XDP sockets in copy mode (Documentation/networking/af_xdp.rst).

use std::fmt;
use std::io;
use std::mem;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd};
use std::ptr::{self, NonNull};
use std::sync::atomic::{AtomicU32, Ordering};

use rustix::mm::{MapFlags, ProtFlags, mmap, mmap_anonymous, munmap};

use super::{checked, length};

/// One place for a frame: 256 bytes that the kernel keeps for itself, and a frame.
const CHUNK: usize = 2048;
/// Places that the kernel fills; a power of two, as all rings are.
const RECEIVE: u32 = 256;
const SEND: u32 = 64;

/// Memory shared with the kernel.
struct Mapping {
    base: NonNull<u8>,
    len: usize,
}

// SAFETY: the mapping belongs to this value alone and is not tied to a thread.
unsafe impl Send for Mapping {}

impl Mapping {
    fn of(base: *mut libc::c_void, len: usize) -> io::Result<Self> {
        let base = NonNull::new(base.cast::<u8>()).ok_or(io::ErrorKind::OutOfMemory)?;
        Ok(Self { base, len })
    }

    fn anonymous(len: usize) -> io::Result<Self> {
        let access = ProtFlags::READ | ProtFlags::WRITE;
        // SAFETY: new memory where the kernel likes.
        let base = unsafe {
            mmap_anonymous(
                ptr::null_mut(),
                len,
                access,
                MapFlags::PRIVATE | MapFlags::POPULATE,
            )?
        };
        Self::of(base, len)
    }

    fn of_ring(socket: &OwnedFd, len: usize, offset: u64) -> io::Result<Self> {
        let access = ProtFlags::READ | ProtFlags::WRITE;
        // SAFETY: a new mapping where the kernel likes; the kernel refuses a length beyond the ring's.
        let base = unsafe {
            mmap(
                ptr::null_mut(),
                len,
                access,
                MapFlags::SHARED | MapFlags::POPULATE,
                socket,
                offset,
            )?
        };
        Self::of(base, len)
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: the mapping is this value's own, and no borrow of it outlives the value.
        let _ = unsafe { munmap(self.base.as_ptr().cast(), self.len) };
    }
}

/// A ring with one writer and one reader, of which this process is one. `T` is what lies in it.
struct Queue<T> {
    memory: Mapping,
    producer: usize,
    consumer: usize,
    entries: usize,
    mask: u32,
    kind: std::marker::PhantomData<T>,
}

impl<T: Copy> Queue<T> {
    fn map(
        socket: &OwnedFd,
        at: &libc::xdp_ring_offset,
        entries: u32,
        page_offset: u64,
    ) -> io::Result<Self> {
        let offset = |n: u64| usize::try_from(n).map_err(|_| io::ErrorKind::InvalidData);
        let (producer, consumer) = (offset(at.producer)?, offset(at.consumer)?);
        let first = offset(at.desc)?;
        let len = first + entries as usize * size_of::<T>();
        let memory = Mapping::of_ring(socket, len, page_offset)?;
        let word = size_of::<AtomicU32>();
        let aligned = producer.is_multiple_of(word)
            && consumer.is_multiple_of(word)
            && first.is_multiple_of(align_of::<T>());
        if !aligned || producer.max(consumer) + word > len || !entries.is_power_of_two() {
            return Err(io::ErrorKind::InvalidData.into());
        }
        Ok(Self {
            memory,
            producer,
            consumer,
            entries: first,
            mask: entries - 1,
            kind: std::marker::PhantomData,
        })
    }

    fn word(&self, at: usize) -> &AtomicU32 {
        // SAFETY: `map` has checked that the word is aligned and lies in the mapping, which lives as long as `self`; both
        // sides access it whole.
        unsafe { self.memory.base.add(at).cast().as_ref() }
    }

    fn entry(&self, n: u32) -> NonNull<T> {
        let at = self.entries + (n & self.mask) as usize * size_of::<T>();
        // SAFETY: masked, the entry lies in the mapping, whose length `map` has computed from the number of entries.
        unsafe { self.memory.base.add(at).cast() }
    }

    /// The newest one that the other side has not taken; only for rings that this process fills.
    fn last(&self) -> Option<T> {
        let producer = self.word(self.producer).load(Ordering::Relaxed);
        if self.word(self.consumer).load(Ordering::Acquire) == producer {
            return None;
        }
        // SAFETY: the entry is valid and aligned (see `entry`), and this process has filled it.
        Some(unsafe { self.entry(producer.wrapping_sub(1)).read() })
    }

    /// Changes the one of [`Queue::last`], if the other side is known not to look.
    fn replace_last(&mut self, value: T) {
        let producer = self.word(self.producer).load(Ordering::Relaxed);
        // SAFETY: the entry is valid and aligned (see `entry`); the caller knows that nobody reads it.
        unsafe { self.entry(producer.wrapping_sub(1)).write(value) };
    }

    /// Puts one in; only for rings that this process fills. False if it is full.
    fn push(&mut self, value: T) -> bool {
        let producer = self.word(self.producer).load(Ordering::Relaxed);
        let used = producer.wrapping_sub(self.word(self.consumer).load(Ordering::Acquire));
        if used > self.mask {
            return false;
        }
        // SAFETY: the entry is valid and aligned (see `entry`), and free: the kernel reads it once it is counted.
        unsafe { self.entry(producer).write(value) };
        self.word(self.producer)
            .store(producer.wrapping_add(1), Ordering::Release);
        true
    }

    /// The oldest one; only for rings that this process empties.
    fn front(&self) -> Option<T> {
        let consumer = self.word(self.consumer).load(Ordering::Relaxed);
        if self.word(self.producer).load(Ordering::Acquire) == consumer {
            return None;
        }
        // SAFETY: the entry is valid and aligned (see `entry`), and the kernel has filled it.
        Some(unsafe { self.entry(consumer).read() })
    }

    /// Takes the one of [`Queue::front`] out.
    fn pop(&mut self) {
        let consumer = self.word(self.consumer).load(Ordering::Relaxed);
        self.word(self.consumer)
            .store(consumer.wrapping_add(1), Ordering::Release);
    }
}

/// A socket that takes the frames which a [`super::bpf::Program`] leads to it. One queue of one interface.
pub struct XdpSocket {
    // The mappings outlive nothing: they go before the socket.
    received: Queue<libc::xdp_desc>,
    free: Queue<u64>,
    to_send: Queue<libc::xdp_desc>,
    sent: Queue<u64>,
    memory: Mapping,
    /// Places to send from that are not under way.
    spare: Vec<u64>,
    fd: OwnedFd,
}

impl AsFd for XdpSocket {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.fd.as_fd()
    }
}

impl XdpSocket {
    /// Memory and rings, bound to a queue of an interface.
    ///
    /// # Errors
    /// What the kernel says: no AF_XDP, not permitted, no such queue, or taken by another.
    pub fn new(interface: i32, queue: u32) -> io::Result<Self> {
        let kind = libc::SOCK_RAW | libc::SOCK_CLOEXEC;
        // SAFETY: plain system call; the result is checked.
        let fd = checked(unsafe { libc::socket(libc::AF_XDP, kind, 0) })?;
        // SAFETY: `fd` is a valid descriptor that nothing else owns.
        let fd = unsafe { OwnedFd::from_raw_fd(fd) };

        let chunks = (RECEIVE + SEND) as usize;
        let memory = Mapping::anonymous(chunks * CHUNK)?;
        // SAFETY: all-zero is a valid xdp_umem_reg.
        let mut region: libc::xdp_umem_reg = unsafe { mem::zeroed() };
        region.addr = memory.base.as_ptr().expose_provenance() as u64;
        region.len = memory.len as u64;
        region.chunk_size = CHUNK as u32;
        set(&fd, libc::XDP_UMEM_REG, &region)?;
        set(&fd, libc::XDP_UMEM_FILL_RING, &RECEIVE)?;
        set(&fd, libc::XDP_UMEM_COMPLETION_RING, &SEND)?;
        set(&fd, libc::XDP_RX_RING, &RECEIVE)?;
        set(&fd, libc::XDP_TX_RING, &SEND)?;

        let at: libc::xdp_mmap_offsets = get(&fd, libc::XDP_MMAP_OFFSETS)?;
        let received = Queue::map(&fd, &at.rx, RECEIVE, libc::XDP_PGOFF_RX_RING as u64)?;
        let to_send = Queue::map(&fd, &at.tx, SEND, libc::XDP_PGOFF_TX_RING as u64)?;
        let mut free = Queue::map(&fd, &at.fr, RECEIVE, libc::XDP_UMEM_PGOFF_FILL_RING)?;
        let sent = Queue::map(&fd, &at.cr, SEND, libc::XDP_UMEM_PGOFF_COMPLETION_RING)?;
        for n in 0..RECEIVE {
            free.push(u64::from(n) * CHUNK as u64);
        }
        let spare = (RECEIVE..RECEIVE + SEND).map(|n| u64::from(n) * CHUNK as u64);

        // SAFETY: all-zero is a valid sockaddr_xdp.
        let mut address: libc::sockaddr_xdp = unsafe { mem::zeroed() };
        address.sxdp_family = libc::AF_XDP as u16;
        address.sxdp_flags = libc::XDP_COPY;
        address.sxdp_ifindex = interface.unsigned_abs();
        address.sxdp_queue_id = queue;
        // SAFETY: the address lives through the call and the length is its size.
        checked(unsafe {
            libc::bind(
                fd.as_raw_fd(),
                (&raw const address).cast(),
                length::<libc::sockaddr_xdp>(),
            )
        })?;
        Ok(Self {
            received,
            free,
            to_send,
            sent,
            memory,
            spare: spare.collect(),
            fd,
        })
    }

    fn chunk(&self, addr: u64, len: u32) -> Option<NonNull<u8>> {
        let start = usize::try_from(addr).ok()?;
        let end = start.checked_add(usize::try_from(len).ok()?)?;
        // SAFETY: the place lies in the memory.
        (end <= self.memory.len).then(|| unsafe { self.memory.base.add(start) })
    }

    /// The next frame that has arrived, if there is one; empty where the kernel names a place that is none. RT: no system
    /// call.
    #[must_use]
    pub fn front(&self) -> Option<&[u8]> {
        let frame = self.received.front()?;
        let Some(start) = self.chunk(frame.addr, frame.len) else {
            return Some(&[]);
        };
        // SAFETY: the place lies in the memory, and is ours until `release` gives it back, which takes `&mut self`.
        Some(unsafe { std::slice::from_raw_parts(start.as_ptr(), frame.len as usize) })
    }

    /// Gives the frame of [`XdpSocket::front`] back. RT.
    pub fn release(&mut self) {
        if let Some(frame) = self.received.front() {
            self.received.pop();
            // There is room: as many places as the ring has entries go around.
            self.free.push(frame.addr & !(CHUNK as u64 - 1));
        }
    }

    /// Sends one frame. RT: one system call, never waits.
    ///
    /// # Errors
    /// What sendto(2) says; NOBUFS where earlier frames are still under way, or the frame is too long.
    pub fn send(&mut self, frame: &[u8]) -> rustix::io::Result<()> {
        use rustix::io::Errno;
        while let Some(addr) = self.sent.front() {
            self.sent.pop();
            // Within the capacity: as many as were taken out.
            self.spare.push(addr & !(CHUNK as u64 - 1));
        }
        let len = u32::try_from(frame.len()).map_err(|_| Errno::MSGSIZE)?;
        if frame.len() > CHUNK {
            return Err(Errno::MSGSIZE);
        }
        // A frame that the interface did not take, because it was down, say, was an error then and must not leave late:
        // this one takes its place.
        let waiting = self.to_send.last();
        let addr = match waiting {
            Some(waiting) => waiting.addr,
            None => self.spare.pop().ok_or(Errno::NOBUFS)?,
        };
        let Some(to) = self.chunk(addr, len) else {
            return Err(Errno::NOBUFS);
        };
        // SAFETY: the place lies in the memory and is not the frame's, which the caller owns. The kernel does not read it:
        // it is not in the ring, or it is and waits for `kick`, by which alone the kernel sends in copy mode.
        unsafe { ptr::copy_nonoverlapping(frame.as_ptr(), to.as_ptr(), frame.len()) };
        let described = libc::xdp_desc {
            addr,
            len,
            options: 0,
        };
        if waiting.is_some() {
            self.to_send.replace_last(described);
        } else if !self.to_send.push(described) {
            self.spare.push(addr);
            return Err(Errno::NOBUFS);
        }
        self.kick()
    }

    /// Lets the kernel send what is in the ring.
    fn kick(&self) -> rustix::io::Result<()> {
        rustix::net::send(&self.fd, &[], rustix::net::SendFlags::DONTWAIT).map(|_| ())
    }

    /// Frames that found no room so far.
    ///
    /// # Errors
    /// What getsockopt(2) says.
    pub fn dropped(&self) -> io::Result<u64> {
        let stats: libc::xdp_statistics = get(&self.fd, libc::XDP_STATISTICS)?;
        // `rx_fill_ring_empty_descs` counts those of `rx_dropped` once more.
        Ok(stats.rx_dropped + stats.rx_ring_full)
    }
}

impl fmt::Debug for XdpSocket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("XdpSocket")
            .field("fd", &self.fd)
            .field("spare", &self.spare.len())
            .finish_non_exhaustive()
    }
}

fn set<T>(fd: &OwnedFd, name: i32, value: &T) -> io::Result<()> {
    // SAFETY: the value lives through the call and the length is its size.
    let result = unsafe {
        libc::setsockopt(
            fd.as_raw_fd(),
            libc::SOL_XDP,
            name,
            (&raw const *value).cast(),
            length::<T>(),
        )
    };
    checked(result).map(|_| ())
}

/// Only for plain numbers, of which all-zero is a value.
fn get<T: Copy>(fd: &OwnedFd, name: i32) -> io::Result<T> {
    // SAFETY: the callers' types are structures of numbers.
    let mut value: T = unsafe { mem::zeroed() };
    let mut len = length::<T>();
    // SAFETY: `value` takes `len` bytes.
    let result = unsafe {
        libc::getsockopt(
            fd.as_raw_fd(),
            libc::SOL_XDP,
            name,
            (&raw mut value).cast(),
            &raw mut len,
        )
    };
    checked(result)?;
    // An old kernel fills less.
    if len == length::<T>() {
        Ok(value)
    } else {
        Err(io::ErrorKind::Unsupported.into())
    }
}
