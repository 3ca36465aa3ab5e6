"""Interfaces of other planners, so that programs that were written for these planners can use this
package."""
