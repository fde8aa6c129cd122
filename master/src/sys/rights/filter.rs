//! The system calls of the process and of the thread of the cycle, as seccomp filters. A call that
//! is refused fails with EPERM.

use std::collections::BTreeMap;

use seccompiler::{
    BpfProgram, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition, SeccompFilter,
    SeccompRule, TargetArch, sock_filter,
};

/// Calls that no thread of a machine's program makes: other programs, other processes, mounts, the
/// kernel, the time, and ways around the other limits.
const NEVER: &[libc::c_long] = &[
    libc::SYS_acct,
    libc::SYS_add_key,
    libc::SYS_adjtimex,
    libc::SYS_bpf,
    libc::SYS_chroot,
    libc::SYS_clock_adjtime,
    libc::SYS_clock_settime,
    libc::SYS_delete_module,
    libc::SYS_execve,
    libc::SYS_execveat,
    libc::SYS_finit_module,
    libc::SYS_fsconfig,
    libc::SYS_fsmount,
    libc::SYS_fsopen,
    libc::SYS_fspick,
    libc::SYS_init_module,
    libc::SYS_io_uring_enter,
    libc::SYS_io_uring_register,
    libc::SYS_io_uring_setup,
    libc::SYS_kcmp,
    libc::SYS_kexec_load,
    libc::SYS_keyctl,
    libc::SYS_mount,
    libc::SYS_mount_setattr,
    libc::SYS_move_mount,
    libc::SYS_name_to_handle_at,
    libc::SYS_open_by_handle_at,
    libc::SYS_open_tree,
    libc::SYS_perf_event_open,
    libc::SYS_personality,
    libc::SYS_pidfd_getfd,
    libc::SYS_pivot_root,
    libc::SYS_process_madvise,
    libc::SYS_process_vm_readv,
    libc::SYS_process_vm_writev,
    libc::SYS_ptrace,
    libc::SYS_quotactl,
    libc::SYS_reboot,
    libc::SYS_request_key,
    libc::SYS_setdomainname,
    libc::SYS_setgid,
    libc::SYS_setgroups,
    libc::SYS_sethostname,
    libc::SYS_setns,
    libc::SYS_setregid,
    libc::SYS_setresgid,
    libc::SYS_setresuid,
    libc::SYS_setreuid,
    libc::SYS_settimeofday,
    libc::SYS_setuid,
    libc::SYS_swapoff,
    libc::SYS_swapon,
    libc::SYS_syslog,
    libc::SYS_umount2,
    libc::SYS_unshare,
    libc::SYS_userfaultfd,
    libc::SYS_vhangup,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_ioperm,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_iopl,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_modify_ldt,
];

/// The flags of `clone` that make namespaces. `CLONE_NEWTIME` is a flag of `clone3` and `unshare`
/// only: in `clone`, its bit belongs to the signal.
const NAMESPACES: [libc::c_int; 7] = [
    libc::CLONE_NEWCGROUP,
    libc::CLONE_NEWIPC,
    libc::CLONE_NEWNET,
    libc::CLONE_NEWNS,
    libc::CLONE_NEWPID,
    libc::CLONE_NEWUSER,
    libc::CLONE_NEWUTS,
];

/// The socket families of a machine's program; netlink is for the names of interfaces.
const FAMILIES: [libc::c_int; 5] = [
    libc::AF_UNIX,
    libc::AF_INET,
    libc::AF_INET6,
    libc::AF_NETLINK,
    libc::AF_PACKET,
];

/// The calls of the thread of the cycle. The judges' section `rights` compares them with what strace
/// sees.
const CYCLE: &[libc::c_long] = &[
    // The cycle. Without a receive ring, frames come by recvmsg. `write` is for an eventfd.
    libc::SYS_clock_gettime,
    libc::SYS_clock_nanosleep,
    libc::SYS_futex,
    libc::SYS_recvfrom,
    libc::SYS_recvmsg,
    libc::SYS_sendmsg,
    libc::SYS_sendto,
    libc::SYS_write,
    // The way back: statistics, the end of the recording, the report of a panic.
    libc::SYS_close,
    libc::SYS_fcntl,
    libc::SYS_getrandom,
    libc::SYS_getrusage,
    libc::SYS_getsockopt,
    libc::SYS_nanosleep,
    libc::SYS_sched_yield,
    libc::SYS_writev,
    // Memory, signals and the end of the thread.
    libc::SYS_brk,
    libc::SYS_exit,
    libc::SYS_exit_group,
    libc::SYS_getpid,
    libc::SYS_gettid,
    libc::SYS_madvise,
    libc::SYS_mremap,
    libc::SYS_munmap,
    libc::SYS_restart_syscall,
    libc::SYS_rt_sigaction,
    libc::SYS_rt_sigprocmask,
    libc::SYS_rt_sigreturn,
    libc::SYS_sigaltstack,
    libc::SYS_tgkill,
];

/// The length of what seccompiler puts first: the check of the processor architecture.
const ARCHITECTURE_CHECK: usize = 3;
/// The number of calls of the x32 ABI start here; they have the architecture of x86_64.
#[cfg(target_arch = "x86_64")]
const X32: u32 = 0x4000_0000;

/// Refuses the calls of [`NEVER`], new namespaces and other socket families to all threads.
pub fn limit_process() -> Result<(), String> {
    let mut rules: BTreeMap<i64, Vec<SeccompRule>> = of_calls(NEVER);
    let other = FAMILIES.map(|family| condition(0, SeccompCmpOp::Ne, family));
    let other = other.into_iter().collect::<Result<_, _>>()?;
    rules.insert(libc::SYS_socket, vec![rule(other)?]);
    let namespaces = NAMESPACES.map(|flag| {
        let bit = flag.cast_unsigned().into();
        rule(vec![condition(0, SeccompCmpOp::MaskedEq(bit), flag)?])
    });
    let namespaces = namespaces.into_iter().collect::<Result<_, _>>()?;
    rules.insert(libc::SYS_clone, namespaces);
    let mut filter = compile(rules, SeccompAction::Allow, refused())?;
    filter.splice(ARCHITECTURE_CHECK..ARCHITECTURE_CHECK, numbers_refused()?);
    seccompiler::apply_filter_all_threads(&filter).map_err(|error| error.to_string())
}

/// Permits the calls of [`CYCLE`] to the calling thread, and memory that is not executable.
pub fn limit_cycle() -> Result<(), String> {
    let mut rules = of_calls(CYCLE);
    for call in [libc::SYS_mmap, libc::SYS_mprotect] {
        let executable = libc::PROT_EXEC.cast_unsigned().into();
        let plain = condition(2, SeccompCmpOp::MaskedEq(executable), 0)?;
        rules.insert(call, vec![rule(vec![plain])?]);
    }
    let filter = compile(rules, refused(), SeccompAction::Allow)?;
    seccompiler::apply_filter(&filter).map_err(|error| error.to_string())
}

/// Returns the instructions that refuse calls by their number alone. A filter cannot read the flags
/// of `clone3`, which are in memory: with ENOSYS, the C library starts threads by `clone`.
fn numbers_refused() -> Result<Vec<sock_filter>, String> {
    let instruction = |code: u32, jt, jf, k| {
        let code = u16::try_from(code).map_err(|error| error.to_string())?;
        Ok::<_, String>(sock_filter { code, jt, jf, k })
    };
    let jump = libc::BPF_JMP | libc::BPF_K;
    let stop = |error: libc::c_int| {
        let value = libc::SECCOMP_RET_ERRNO | error.cast_unsigned();
        instruction(libc::BPF_RET | libc::BPF_K, 0, 0, value)
    };
    let clone3 = u32::try_from(libc::SYS_clone3).map_err(|error| error.to_string())?;
    Ok(vec![
        // The number is the first word of `seccomp_data`.
        instruction(libc::BPF_LD | libc::BPF_W | libc::BPF_ABS, 0, 0, 0)?,
        instruction(jump | libc::BPF_JEQ, 0, 1, clone3)?,
        stop(libc::ENOSYS)?,
        #[cfg(target_arch = "x86_64")]
        instruction(jump | libc::BPF_JGE, 0, 1, X32)?,
        #[cfg(target_arch = "x86_64")]
        stop(libc::EPERM)?,
    ])
}

fn of_calls(calls: &[libc::c_long]) -> BTreeMap<i64, Vec<SeccompRule>> {
    calls.iter().map(|call| (*call, Vec::new())).collect()
}

fn refused() -> SeccompAction {
    SeccompAction::Errno(libc::EPERM.cast_unsigned())
}

fn condition(
    argument: u8,
    operator: SeccompCmpOp,
    value: libc::c_int,
) -> Result<SeccompCondition, String> {
    let value = u64::from(value.cast_unsigned());
    SeccompCondition::new(argument, SeccompCmpArgLen::Dword, operator, value)
        .map_err(|error| error.to_string())
}

fn rule(conditions: Vec<SeccompCondition>) -> Result<SeccompRule, String> {
    SeccompRule::new(conditions).map_err(|error| error.to_string())
}

fn compile(
    rules: BTreeMap<i64, Vec<SeccompRule>>,
    otherwise: SeccompAction,
    matched: SeccompAction,
) -> Result<BpfProgram, String> {
    let arch = TargetArch::try_from(std::env::consts::ARCH).map_err(|error| error.to_string())?;
    let filter = SeccompFilter::new(rules, otherwise, matched, arch);
    let program = filter.and_then(BpfProgram::try_from);
    program.map_err(|error| error.to_string())
}
