/** Why a text cannot name a session; null when it can. The daemon has the last word. */
export function checkName(name: string): string | null {
  if (name.length === 0) return "A session needs a name.";
  if (name.length > 120) return "That name is too long: 120 characters at most.";
  if (!/^[\p{L}\p{N}][\p{L}\p{N}._-]*$/u.test(name)) {
    return "A name has letters, digits, dot, dash and underscore only, and begins with a letter or digit.";
  }
  return null;
}
